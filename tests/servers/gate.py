"""A place before a server that lets requests through together: no clock tells how they came."""

import socket
import socketserver
import threading
from contextlib import suppress

from tests.sources.policies import LONGEST_S


class Gate:
    """A place before a server of this machine that counts requests, and can hold them back."""

    def __init__(self, url):
        self.asked, self.came_together = 0, True
        self._count, self._there = 0, threading.Event()
        self._there.set()
        gate, (host, port) = self, url.rpartition("/")[2].split(":")

        class Handler(socketserver.BaseRequestHandler):
            def handle(self):
                with socket.create_connection((host, int(port))) as server:
                    back = threading.Thread(target=pump, args=(server, self.request), daemon=True)
                    back.start()
                    with suppress(OSError):  # whoever asked may reset the connection
                        while request := self.request.recv(65536):
                            gate.pass_on()
                            server.sendall(request)
                    with suppress(OSError):
                        server.shutdown(socket.SHUT_RDWR)
                    back.join()

        def pump(server, client):
            with suppress(OSError):
                while answer := server.recv(65536):
                    client.sendall(answer)

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def hold_until(self, count):
        """Hold requests back until so many have come."""
        self._count = self.asked + count
        self._there.clear()

    def pass_on(self):
        self.asked += 1
        if self.asked >= self._count:
            self._there.set()
        self.came_together &= self._there.wait(LONGEST_S)

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self._there.set()
        self._server.shutdown()
        self._server.server_close()
