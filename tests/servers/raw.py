"""A server that answers each request with whatever bytes a test gives, at whatever pace."""

import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

Answering = Callable[[int, int], Iterator[bytes | float]]
"""From the range asked for to what is sent: bytes, and seconds to wait; at the end it hangs up."""


@contextmanager
def raw_serving(answering: Answering) -> Iterator[str]:
    """Answer on a free port of this machine; yields the address."""
    stopped = threading.Event()
    listening = socket.create_server(("127.0.0.1", 0))
    threads: list[threading.Thread] = []

    def answer(connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as incoming, suppress(OSError):
            head = b""
            while not head.endswith(b"\r\n\r\n"):
                line = incoming.readline()
                if not line:
                    return
                head += line
            found = re.search(rb"Range: bytes=(\d+)-(\d+)", head, re.IGNORECASE)
            start, stop = (int(found[1]), int(found[2]) + 1) if found else (0, 0)
            for part in answering(start, stop):
                if isinstance(part, bytes):
                    connection.sendall(part)
                elif stopped.wait(part):
                    return

    def accept() -> None:
        while not stopped.is_set():
            with suppress(OSError):
                connection, _ = listening.accept()
                thread = threading.Thread(target=answer, args=(connection,), daemon=True)
                threads.append(thread)
                thread.start()

    accepting = threading.Thread(target=accept, daemon=True)
    accepting.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        stopped.set()
        with suppress(OSError):
            listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        accepting.join()
        for thread in threads:
            thread.join()
