"""Streams of lines from pipes, sockets, serial ports and files.

A batch has all lines that have arrived since the previous one, so that a slow reader catches up. Batches of datagrams
take their senders in turns.
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
"""Kinds of addresses."""
_CHUNK = 65536
_TCP_CHUNK = 2**20
_DATAGRAMS = 200  # of a socket, read at once: more would delay those that were read
_OWN_SOCKETS = 8
_PAUSE_S = 0.002  # before senders without a row are served: a flood must not take the whole processor
LONGEST_LINE = 2**20
"""Length [bytes] above which a line without an end counts as garbled."""
_CONNECTION_S = 10.0
_UDP_BUFFER = 2**22
_LONGEST_PAUSE_S = 10.0


@dataclass(frozen=True)
class Stream:
    """Lines from one address.

    Attributes
    ----------
    name : str
        Name of the stream in errors.
    batches : iterator of Batch
        Complete lines that have arrived since the previous batch.
    accept : callable
        The reader calls it with the sender of rows or of a header.
    """

    name: str
    batches: Iterator[Batch]
    accept: Callable[[Hashable], object] = lambda _: None


def sender_waits(address: str) -> bool:
    """Return whether the sender waits for a slow reader, as a pipe and a file do."""
    return address == STANDARD_INPUT or address.startswith("replay:")


@contextmanager
def open_stream(address: str, *, replay_speed: float = 1.0, form: LogFormat = READINGS_FILE) -> Iterator[Stream]:
    """Open the stream of an address; raise InputError if that is not possible.

    ``form`` describes the times in the rows of a file.
    """
    if address == STANDARD_INPUT:
        yield Stream("standard input", _split_lines(_read_stdin()))
        return
    kind, _, rest = address.partition(":")
    match kind:
        case "tcp":
            with _connect(address) as peer:
                yield Stream(address, _split_lines(_receive(peer)))
        case "udp":
            with _bind(address) as own, ExitStack() as stack:
                datagrams = _DatagramPort(own, stack)
                yield Stream(address, datagrams.batches(), datagrams.accept)
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
                yield Stream(address, _split_lines(_read_serial(port)))
        case "replay":
            check_positive(replay_speed=replay_speed)
            lines = read_bytes(rest, "a readings file").splitlines()
            yield Stream(rest, _replay(lines, replay_speed, form))
        case _:
            raise InputError(f"{address}: found no such kind of source, expected {KINDS}.")


def _reason(error: Exception) -> str:
    """Return the message of the system, without the text that pyserial and Python put around it."""
    return getattr(error, "strerror", None) or str(error)


def _split_lines(chunks: Iterator[bytes]) -> Iterator[Batch]:
    """Split chunks of bytes into lines; the last line may have no end."""
    rest = b""
    for chunk in chunks:
        *lines, rest = (rest + chunk).split(b"\n")
        if len(rest) > LONGEST_LINE:
            lines.append(rest)
            rest = b""
        if lines:
            yield Batch(lines)
    if rest:
        yield Batch([rest])


def _read_stdin() -> Iterator[bytes]:
    buffer = getattr(sys.stdin, "buffer", None)
    if buffer is None:  # a caller has put a text stream in its place
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
def _connect(address: str) -> Iterator[socket.socket]:
    """Connect to a sender."""
    host_and_port = _host_and_port(address)
    try:
        peer = socket.create_connection(host_and_port, timeout=_CONNECTION_S)
    except (OSError, UnicodeError) as error:
        raise InputError(f"{address}: cannot be reached ({_reason(error)}), expected a sender of rows.") from None
    with peer:
        peer.settimeout(None)
        yield peer


def _receive(peer: socket.socket) -> Iterator[bytes]:
    quick = getattr(socket, "TCP_QUICKACK", None)  # Linux
    try:
        while chunk := peer.recv(_TCP_CHUNK):
            if quick is not None:
                # A sender with Nagle's algorithm waits for this; the system resets the option.
                peer.setsockopt(socket.IPPROTO_TCP, quick, 1)
            yield chunk
    except ConnectionError:  # an end of the stream too
        return


@contextmanager
def _bind(address: str) -> Iterator[socket.socket]:
    """Open a socket for datagrams."""
    host, port = _host_and_port(address)
    try:
        family, kind, protocol, _, own_address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as own:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UDP_BUFFER)
            own.bind(own_address)
            bound = own.dup()
    except (OSError, UnicodeError) as error:
        expected = "expected a free port of this machine"
        raise InputError(f"{address}: cannot be opened for listening ({_reason(error)}), {expected}.") from None
    with bound:
        yield bound


class _DatagramPort:
    """Datagrams that arrive at a port, by sender. No line continues in the next datagram.

    On Linux a good sender gets a separate socket, so that a flood from others cannot fill its buffer.
    """

    def __init__(self, common: socket.socket, stack: ExitStack) -> None:
        common.setblocking(False)
        self._common, self._stack = common, stack
        self._own: dict[Hashable, socket.socket] = {}
        self._senders = Senders()

    def batches(self) -> Iterator[Batch]:
        """Yield the lines of the datagrams that wait, one sender at a time."""
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
        """Record that a sender has sent a row or a header."""
        self._senders.accept(sender)
        if sys.platform == "linux" and sender not in self._own and len(self._own) < _OWN_SOCKETS:
            with suppress(OSError):  # the sender then uses the common socket
                self._own[sender] = self._open_socket(sender)

    def _open_socket(self, sender: Hashable) -> socket.socket:
        """Open a socket of the same port for the datagrams of one sender."""
        common = self._common
        own = self._stack.enter_context(socket.socket(common.family, common.type, common.proto))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UDP_BUFFER)
        own.setblocking(False)
        for each in (common, own):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind(common.getsockname())
        finally:  # otherwise another program could take the port
            for each in (common, own):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        own.connect(sender)  # type: ignore[arg-type]  # an address
        return own

    def _receive(self) -> None:
        """Read the datagrams that wait."""
        buffer = bytearray(_CHUNK)  # one for all: large buffers cut to size would fragment the memory
        for each in (*self._own.values(), self._common):
            with suppress(BlockingIOError, ConnectionError):
                for _ in range(_DATAGRAMS):
                    size, sender = each.recvfrom_into(buffer)
                    self._senders.put(bytes(buffer[:size]), sender)


def _read_serial(port: serial.Serial) -> Iterator[bytes]:  # type: ignore[name-defined]  # noqa: F821 - an extra
    import serial

    while True:
        try:
            yield port.read(port.in_waiting or 1)
        except (serial.SerialException, OSError):  # unplugged
            return


def _replay(lines: list[bytes], speed: float, form: LogFormat) -> Iterator[Batch]:
    """Yield the lines of a readings file at the times of their rows, without long pauses."""
    texts = (line.removeprefix(b"\xef\xbb\xbf").decode(errors="replace") for line in lines)
    seconds_of = form.clock(next(filter(form.begins, texts), ""))
    due_s, last_s = time.monotonic(), math.inf
    waiting: list[bytes] = []
    for line in lines:
        with suppress(IndexError, ValueError):  # a line without a time follows the previous one at once
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
