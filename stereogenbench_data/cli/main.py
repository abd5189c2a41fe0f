"""Entry point of ``stereogenbench``: signals stop it without a traceback, also while it imports."""

import signal
import sys


def main() -> None:
    """Run the command line; SIGTERM stops it as Ctrl-C does."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from stereogenbench_data.cli.commands import run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
