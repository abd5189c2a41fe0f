"""Connections of this process to web servers, which keep within the limits of an attempt.

Each process makes its own; those inherited over a fork are closed. Waits for names, connections,
TLS, heads and bodies all count, and another thread can end them.
"""

import atexit
import http.client
import io
import logging
import os
import socket
import weakref
from collections.abc import Mapping
from contextvars import ContextVar
from functools import partial
from typing import Any, Final
from urllib.request import getproxies, proxy_bypass

import urllib3
import urllib3.connection
from urllib3.exceptions import ConnectTimeoutError, NameResolutionError, NewConnectionError
from urllib3.util.connection import allowed_gai_family

from stereogenbench_data.sources.location import split_url
from stereogenbench_data.sources.retry import Attempt, TooSlow, shut_down

_MOST_CONNECTIONS: Final = 64
"""Connections to one server that a process keeps for later requests."""

_pools: Final[dict[tuple[int, str], urllib3.PoolManager]] = {}
"""Connections by process and proxy. Those inherited over a fork are not used: their sockets belong
to the parent."""

_sockets: Final[weakref.WeakSet[socket.socket]] = weakref.WeakSet()
"""The open connections of this process."""

_current_attempt: Final[ContextVar[Attempt | None]] = ContextVar("_current_attempt", default=None)
"""The attempt that this thread's request belongs to."""


class _TimedStream(io.RawIOBase):
    """The bytes of a connection; waits for them stay within the limits of the attempt."""

    def __init__(self, stream: io.RawIOBase, connection: socket.socket, attempt: Attempt) -> None:
        super().__init__()
        self._stream = stream
        self._connection = connection
        self._attempt = attempt

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int | None:
        self._connection.settimeout(self._attempt.next_wait_s())
        began_s, count = self._attempt.clock(), 0
        try:
            count = self._stream.readinto(buffer) or 0
        except TooSlow:
            raise
        except TimeoutError:
            self._attempt.add(self._attempt.clock() - began_s, 0)
            raise self._attempt.too_slow() from None
        self._attempt.add(self._attempt.clock() - began_s, count)
        return count

    def close(self) -> None:
        self._stream.close()
        super().close()


class _TimedResponse(http.client.HTTPResponse):
    """A response whose head and body arrive within the limits of the attempt."""

    def __init__(self, sock: socket.socket, *args: Any, **how: Any) -> None:
        super().__init__(sock, *args, **how)
        attempt = _current_attempt.get()
        if attempt is not None:
            _sockets.add(sock)
            attempt.on_cancel(partial(shut_down, sock))
            self.fp = io.BufferedReader(_TimedStream(self.fp.detach(), sock, attempt))


class _TimedConnection(urllib3.connection.HTTPConnection):
    """A connection that is made within the limits of the attempt, all its addresses together."""

    response_class = _TimedResponse
    _during_handshake: socket.socket | None = None
    _handshake_from_s = 0.0

    def connect(self) -> None:
        """Connect, and make the connection secure where it is to be."""
        try:
            super().connect()
        finally:
            attempt = _current_attempt.get()
            if self._during_handshake is not None and attempt is not None:
                attempt.add(attempt.clock() - self._handshake_from_s, 0)
                self._during_handshake.close()
                self._during_handshake = None

    def _new_conn(self) -> socket.socket:
        attempt = _current_attempt.get()
        if attempt is None:
            return super()._new_conn()
        try:
            connection = self._connected(attempt)
            allowed_s = attempt.next_wait_s()
        except socket.gaierror as error:
            raise NameResolutionError(self.host, self, error) from error
        except TooSlow as error:
            raise ConnectTimeoutError(self, str(error)) from error
        except TimeoutError as error:
            raise ConnectTimeoutError(self, "timed out") from error
        except OSError as error:
            raise NewConnectionError(self, "no connection") from error
        # TLS takes the socket over: a copy can be shut down meanwhile.
        self._during_handshake = connection.dup()
        self._handshake_from_s = attempt.clock()
        attempt.on_cancel(partial(shut_down, self._during_handshake))
        connection.settimeout(allowed_s)
        return connection

    def _connected(self, attempt: Attempt) -> socket.socket:
        """Return a connection to the first of the host's addresses that accepts one."""
        refused: OSError | None = None
        began_s = attempt.clock()
        found = socket.getaddrinfo(
            self._dns_host.strip("[]"), self.port, allowed_gai_family(), socket.SOCK_STREAM
        )
        attempt.add(attempt.clock() - began_s, 0)
        for family, kind, protocol, _, address in found:
            connection = socket.socket(family, kind, protocol)
            began_s = attempt.clock()
            try:
                for option in self.socket_options or ():
                    connection.setsockopt(*option)
                attempt.on_cancel(partial(shut_down, connection))
                connection.settimeout(attempt.next_wait_s())
                connection.connect(address)
            except OSError as error:
                connection.close()
                refused = error
            else:
                return connection
            finally:
                attempt.add(attempt.clock() - began_s, 0)
        raise refused or OSError("the host has no address")


class _Connection(_TimedConnection):
    pass


class _SecureConnection(_TimedConnection, urllib3.connection.HTTPSConnection):
    pass


class _Pool(urllib3.HTTPConnectionPool):
    ConnectionCls = _Connection


class _SecurePool(urllib3.HTTPSConnectionPool):
    ConnectionCls = _SecureConnection


def _pool(url: str) -> urllib3.PoolManager:
    """Return the connections of this process, through the machine's proxy where it has one."""
    parts = split_url(url)
    proxy = "" if proxy_bypass(parts.netloc) else getproxies().get(parts.scheme, "")
    key = (os.getpid(), proxy)
    if key not in _pools:
        pool = (
            urllib3.ProxyManager(proxy, maxsize=_MOST_CONNECTIONS)
            if proxy
            else urllib3.PoolManager(maxsize=_MOST_CONNECTIONS)
        )
        pool.pool_classes_by_scheme = {"http": _Pool, "https": _SecurePool}
        _pools.setdefault(key, pool)
    return _pools[key]


def request(url: str, *, headers: Mapping[str, str], attempt: Attempt) -> urllib3.BaseHTTPResponse:
    """Return a server's response to a GET, of which nothing but the head is read yet.

    Args:
        url: The whole URL; redirects are not followed.
        headers: Of the request.
        attempt: Its limits hold for the connection, the head and the body.

    Raises:
        TooSlow: If no time is left.
        HTTPError: If there is no response.
        LocationValueError: If the URL is not valid.
        UnicodeError: The same.
    """
    token = _current_attempt.set(attempt)
    try:
        allowed_s = attempt.next_wait_s()
        return _pool(url).request(
            "GET",
            url,
            headers=headers,
            timeout=urllib3.Timeout(connect=allowed_s, read=allowed_s),
            retries=False,
            redirect=False,
            preload_content=False,
        )
    finally:
        _current_attempt.reset(token)


@atexit.register
def close_connections() -> None:
    """Close the connections of this process; reading opens new ones."""
    for key in [key for key in _pools if key[0] == os.getpid()]:
        _pools.pop(key).clear()


def failure_reason(error: BaseException) -> str:
    """Return what happened, without the URL that urllib3's messages hold."""
    reason = getattr(error, "reason", None)
    inner = reason if isinstance(reason, BaseException) else error
    cause = inner.__cause__ or inner.__context__
    if isinstance(cause, TooSlow):
        return str(cause)
    if isinstance(cause, OSError) and cause.strerror:
        return f"{type(inner).__name__}: {cause.strerror}"
    return type(inner).__name__


def _leave_connections() -> None:
    """Close this process's copies of the connections of the process that it was forked from.

    Locks may be held there by threads that do not exist here, so none is used.
    """
    for connection in list(_sockets):
        number = connection.detach()
        if number >= 0:
            os.close(number)
    _sockets.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_connections)


class _WithoutQueries(logging.Filter):
    """Removes the queries of requested URLs, which may be signed, from what urllib3 logs."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Keep every record, changed where it is of a request of this module."""
        if _current_attempt.get() is not None and isinstance(record.args, tuple):
            record.args = tuple(
                each.partition("?")[0] if isinstance(each, str) else each for each in record.args
            )
        return True


logging.getLogger("urllib3.connectionpool").addFilter(_WithoutQueries())
