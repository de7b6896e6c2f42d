"""Where rows come from: addresses of pipes, sockets, serial ports and files, and the lines that arrive there.

Lines come in batches: all that have arrived since the last look, so that whoever is behind catches up; of datagrams in
turns of their senders.
"""

from __future__ import annotations

import math
import select
import socket
import sys
import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

from arrays.io.errors import InputError, check_positive, of_extra
from arrays.io.text import read_bytes
from arrays.logs.format import READINGS_FILE, LogFormat
from magloc.live.senders import Batch, Senders

STANDARD_INPUT = "-"
KINDS = "-, tcp://HOST:PORT, udp://HOST:PORT, serial:DEVICE@BAUD or replay:FILE"
"""Of addresses."""
_CHUNK = 65536
_ALL_THAT_WAITS = 2**20  # bytes of a connection, read at once
_DATAGRAMS = 200  # of a socket, read at once: more would keep what was read from being handed out
_OWN_SOCKETS = 8
_PAUSE_S = 0.002  # before senders of nothing but what is no row are heard: a flood must not take the whole processor
LONGEST_LINE = 2**20
"""Bytes: what has no line end until then is a garbled line."""
_CONNECTION_S = 10.0
_UDP_BUFFER = 2**22
_LONGEST_PAUSE_S = 10.0


@dataclass(frozen=True)
class Stream:
    """Lines that come in.

    Attributes
    ----------
    name : str
        In errors.
    batches : iterator of Batch
        Whole lines that have arrived since the last ones.
    accept : callable
        To be called with the sender of lines that were rows or a header.
    """

    name: str
    batches: Iterator[Batch]
    accept: Callable[[Hashable], object] = lambda _: None


def sender_waits(address: str) -> bool:
    """Whether whoever sends waits for a slow reader: a pipe and a file do."""
    return address == STANDARD_INPUT or address.startswith("replay:")


@contextmanager
def opened(address: str, *, replay_speed: float = 1.0, form: LogFormat = READINGS_FILE) -> Iterator[Stream]:
    """What comes in at an address, in a form that tells the time of a row; InputError if nothing can."""
    if address == STANDARD_INPUT:
        yield Stream("standard input", _lines(_of_stdin()))
        return
    kind, _, rest = address.partition(":")
    match kind:
        case "tcp":
            with _connected(address) as peer:
                yield Stream(address, _lines(_of_tcp(peer)))
        case "udp":
            with _bound(address) as peer, ExitStack() as stack:
                port_of_all = _Port(peer, stack)
                yield Stream(address, port_of_all.batches(), port_of_all.accept)
        case "serial":
            device, separator, baud = rest.rpartition("@")
            if not (separator and device and baud.isascii() and baud.isdigit() and int(baud)):
                raise InputError(f"{address}: found no device with its baud rate, expected serial:DEVICE@BAUD.")
            with of_extra("serial", "a serial port"):
                import serial
            try:
                port = serial.Serial(device, int(baud))
            except (OSError, ValueError, OverflowError) as error:
                raise InputError(f"{address}: cannot be opened ({_reason(error)}), expected a serial port.") from None
            with port:
                yield Stream(address, _lines(_of_serial(port)))
        case "replay":
            check_positive(replay_speed=replay_speed)
            lines = read_bytes(rest, "a readings file").splitlines()
            yield Stream(rest, _in_own_time(lines, replay_speed, form))
        case _:
            raise InputError(f"{address}: found no such kind of source, expected {KINDS}.")


def _reason(error: Exception) -> str:
    """What the system says, without what pyserial and Python put around it."""
    return getattr(error, "strerror", None) or str(error)


def _lines(chunks: Iterator[bytes]) -> Iterator[Batch]:
    """Whole lines of chunks of bytes; the last one may have no end."""
    begun = b""
    for chunk in chunks:
        *whole, begun = (begun + chunk).split(b"\n")
        if len(begun) > LONGEST_LINE:
            whole.append(begun)
            begun = b""
        if whole:
            yield Batch(whole)
    if begun:
        yield Batch([begun])


def _of_stdin() -> Iterator[bytes]:
    buffer = getattr(sys.stdin, "buffer", None)
    if buffer is None:  # somebody's text
        yield from (line.encode() for line in sys.stdin)
        return
    while chunk := buffer.read1(_CHUNK):
        yield chunk


def _host_and_port(address: str) -> tuple[str, int]:
    parts: SplitResult | None = None
    try:
        parts = urlsplit(address)
        if parts.hostname and parts.port and not (parts.path or parts.query or parts.fragment or parts.username):
            return parts.hostname, parts.port
    except ValueError:
        pass
    raise InputError(f"{address}: found no host with a port, expected {address.partition(':')[0]}://HOST:PORT.")


@contextmanager
def _connected(address: str) -> Iterator[socket.socket]:
    """A connection to whoever sends."""
    where = _host_and_port(address)
    try:
        peer = socket.create_connection(where, timeout=_CONNECTION_S)
    except (OSError, UnicodeError) as error:
        raise InputError(f"{address}: cannot be reached ({_reason(error)}), expected a sender of rows.") from None
    with peer:
        peer.settimeout(None)
        yield peer


def _of_tcp(peer: socket.socket) -> Iterator[bytes]:
    quick = getattr(socket, "TCP_QUICKACK", None)  # Linux
    try:
        while chunk := peer.recv(_ALL_THAT_WAITS):
            if quick is not None:
                # A sender that gathers what is small (Nagle) waits for this; the system forgets the option again.
                peer.setsockopt(socket.IPPROTO_TCP, quick, 1)
            yield chunk
    except ConnectionError:  # as good an end as another
        return


@contextmanager
def _bound(address: str) -> Iterator[socket.socket]:
    """A socket that others send to."""
    host, port = _host_and_port(address)
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as own:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UDP_BUFFER)
            own.bind(where)
            bound = own.dup()
    except (OSError, UnicodeError) as error:
        expected = "expected a free port of this machine"
        raise InputError(f"{address}: cannot be listened at ({_reason(error)}), {expected}.") from None
    with bound:
        yield bound


class _Port:
    """Datagrams that arrive at a port, handed out by sender; each ends with its last line.

    On Linux a good sender gets a socket of its own, with a buffer that no flood fills.
    """

    def __init__(self, common: socket.socket, stack: ExitStack) -> None:
        common.setblocking(False)
        self._common, self._stack = common, stack
        self._own: dict[Hashable, socket.socket] = {}
        self._senders = Senders()

    def batches(self) -> Iterator[Batch]:
        """Lines of the datagrams that wait, of one sender at a time."""
        senders = self._senders
        while True:
            select.select([self._common, *self._own.values()], [], [], 0.0 if senders else None)
            self._receive()
            if senders and not senders.is_urgent:
                time.sleep(_PAUSE_S)
                self._receive()
            if senders:
                yield senders.take()

    def accept(self, sender: Hashable) -> None:
        """Note that a sender sent a row or a header."""
        self._senders.accept(sender)
        if sys.platform == "linux" and sender not in self._own and len(self._own) < _OWN_SOCKETS:
            with suppress(OSError):  # the sender then stays among the others
                self._own[sender] = self._socket_of(sender)

    def _socket_of(self, sender: Hashable) -> socket.socket:
        """A socket of the same port, connected to a sender, to which the system hands that sender's datagrams."""
        common = self._common
        own = self._stack.enter_context(socket.socket(common.family, common.type, common.proto))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UDP_BUFFER)
        own.setblocking(False)
        for each in (common, own):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind(common.getsockname())
        finally:  # or another program could take the port
            for each in (common, own):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        own.connect(sender)  # type: ignore[arg-type]  # an address
        return own

    def _receive(self) -> None:
        """Take in the datagrams that wait."""
        buffer = bytearray(_CHUNK)  # one for all: bytes that are shortened afterwards leave holes in the memory
        for each in (*self._own.values(), self._common):
            with suppress(BlockingIOError, ConnectionError):
                for _ in range(_DATAGRAMS):
                    size, sender = each.recvfrom_into(buffer)
                    self._senders.put(bytes(buffer[:size]), sender)


def _of_serial(port: serial.Serial) -> Iterator[bytes]:  # type: ignore[name-defined]  # noqa: F821 - an extra
    import serial

    while True:
        try:
            yield port.read(port.in_waiting or 1)
        except (serial.SerialException, OSError):  # unplugged
            return


def _in_own_time(lines: list[bytes], speed: float, form: LogFormat) -> Iterator[Batch]:
    """Lines of a readings file, each when its time has come; nobody waits for long pauses."""
    texts = (line.removeprefix(b"\xef\xbb\xbf").decode(errors="replace") for line in lines)
    seconds_of = form.clock(next(filter(form.begins, texts), ""))
    due_s, last_s = time.monotonic(), math.inf
    waiting: list[bytes] = []
    for line in lines:
        with suppress(IndexError, ValueError):  # what has no time comes with the line before
            time_s = seconds_of(line.decode(errors="replace"))
            step_s, last_s = time_s - last_s, time_s
            due_s += step_s / speed if 0.0 < step_s <= _LONGEST_PAUSE_S * speed else 0.0
        if due_s > time.monotonic():
            if waiting:
                yield Batch(waiting)
                waiting = []
            time.sleep(max(0.0, due_s - time.monotonic()))
        waiting.append(line)
    if waiting:
        yield Batch(waiting)
