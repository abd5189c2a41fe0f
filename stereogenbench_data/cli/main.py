"""Entry point of the command ``stereogenbench``: sets up Ctrl-C before the long imports."""

from stereogenbench_data.cli.stopping import stop_at_once


def main() -> None:
    """Run the command line."""
    stop_at_once()
    from stereogenbench_data.cli.commands import run

    run()


if __name__ == "__main__":
    main()
