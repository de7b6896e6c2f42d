"""Lines that come in by sockets, serial ports, files and pipes, and addresses where nothing can."""

from __future__ import annotations

import io
import os
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from arrays.columns import LogColumns
from arrays.io.errors import InputError
from arrays.logs.format import READINGS_FILE, LogFormat
from magloc.live import transports
from magloc.live.transports import open_stream

TEXT = b"time_s,a\n0,1\n1,2\n\n2,3"
LINES = TEXT.split(b"\n")


def lines_at(address: str, **options: float) -> list[bytes]:
    with open_stream(address, **options) as stream:
        return [line for batch in stream.batches for line in batch.lines]


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(60.0)
        yield listening


def sending(server: socket.socket, pieces: Sequence[bytes]) -> threading.Thread:
    """Somebody who sends pieces to the first who connects, and goes."""

    def send() -> None:
        peer, _ = server.accept()
        with peer:
            for piece in pieces:
                peer.sendall(piece)

    thread = threading.Thread(target=send)
    thread.start()
    return thread


class TestTcp:
    @pytest.mark.parametrize("size", [1, 3, 100])
    def test_lines_in_whatever_pieces(self, server: socket.socket, size: int) -> None:
        thread = sending(server, [TEXT[i : i + size] for i in range(0, len(TEXT), size)])
        assert lines_at(f"tcp://127.0.0.1:{server.getsockname()[1]}") == LINES
        thread.join()

    def test_what_has_no_line_end_is_let_go(self, server: socket.socket) -> None:
        endless = b"1" * (2 * transports.LONGEST_LINE)
        thread = sending(server, [endless, b"\n", TEXT])
        found = lines_at(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        assert found[-len(LINES) :] == LINES
        assert b"".join(found[: -len(LINES)]) == endless
        thread.join()

    def test_nobody_there(self) -> None:
        with closing(socket.create_server(("127.0.0.1", 0))) as server:
            port = server.getsockname()[1]
        with pytest.raises(InputError, match=rf"tcp://127.0.0.1:{port}: cannot be reached \(Connection refused\)"):
            lines_at(f"tcp://127.0.0.1:{port}")


class TestUdp:
    def test_a_datagram_ends_with_its_last_line(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        found: list[bytes] = []
        with (
            open_stream(f"udp://127.0.0.1:{port}") as stream,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        ):
            for datagram in (b"time_s,a\n0,1", b"1,2\n", b"\n2,3"):
                sender.sendto(datagram, ("127.0.0.1", port))
            while len(found) < len(LINES):
                found += next(stream.batches).lines
        assert found == LINES

    def test_a_good_sender_is_heard_beside_a_full_buffer(self) -> None:
        """Its datagrams come once each, in order, before and after it is known, and the port stays taken."""
        found: dict[object, list[bytes]] = {}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = ("127.0.0.1", probe.getsockname()[1])
        with (
            open_stream(f"udp://127.0.0.1:{port[1]}") as stream,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as good,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreign,
        ):
            good.bind(("127.0.0.1", 0))
            for i in range(20):
                good.sendto(b"%d" % i, port)
                for _ in range(1000 if sys.platform == "linux" and i > 2 else 1):
                    foreign.sendto(b"x" * 1000, port)
                while len(found.get(good.getsockname(), ())) <= i:
                    batch = next(stream.batches)
                    found.setdefault(batch.sender, []).extend(batch.lines)
                stream.accept(good.getsockname())
            assert found[good.getsockname()] == [b"%d" % i for i in range(20)]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                with pytest.raises(OSError, match="in use"):
                    other.bind(port)

    def test_a_port_in_use(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
            with pytest.raises(InputError, match=rf"udp://127.0.0.1:{port}: .*\(Address already in use\)"):
                lines_at(f"udp://127.0.0.1:{port}")


class TestSerial:
    @pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
    def test_lines_until_it_is_unplugged(self) -> None:
        import pty
        import tty

        master, slave = pty.openpty()
        tty.setraw(slave)
        with open_stream(f"serial:{os.ttyname(slave)}@115200") as stream:
            os.write(master, TEXT + b"\n")
            found: list[bytes] = []
            while len(found) < len(LINES):
                found += next(stream.batches).lines
            os.close(slave)
            os.close(master)
            assert list(stream.batches) == []
        assert found == LINES

    def test_no_such_device(self) -> None:
        with pytest.raises(InputError, match=r"serial:/dev/none@9600: cannot be opened .*No such file"):
            lines_at("serial:/dev/none@9600")

    @pytest.mark.parametrize("rest", ["", "/dev/ttyUSB0", "/dev/ttyUSB0@", "@9600", "/dev/ttyUSB0@fast", "/dev/x@0"])
    def test_without_its_rate(self, rest: str) -> None:
        with pytest.raises(InputError, match="expected serial:DEVICE@BAUD"):
            lines_at(f"serial:{rest}")

    def test_without_the_extra(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "serial", None)
        with pytest.raises(InputError, match=r'a serial port needs the extra "serial": pip install "magloc\[serial\]"'):
            lines_at("serial:/dev/ttyUSB0@9600")


class Time:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class TestReplay:
    def arrivals(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, speed: float = 1.0, form: LogFormat = READINGS_FILE
    ) -> list[tuple[bytes, float]]:
        time = Time()
        monkeypatch.setattr(transports, "time", time)
        with open_stream(f"replay:{path}", replay_speed=speed, form=form) as stream:
            return [(line, time.now_s - 100.0) for batch in stream.batches for line in batch.lines]

    @pytest.mark.parametrize("speed", [1.0, 10.0])
    def test_every_line_comes_when_its_time_has_come(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: float
    ) -> None:
        """But where the file pauses for long, or has a line without a time, nobody has to wait."""
        rows = [(5.0, 0.0), (5.5, 0.5), (6.0, 1.0), (3000.0, 1.0), (3001.0, 2.0), (2.0, 2.0), (3.0, 3.0)]
        text = "\n".join(["a,time_s", *(f"7,{time_s}" for time_s, _ in rows), "garbled"])
        (tmp_path / "rows.csv").write_text(text)
        found = self.arrivals(tmp_path / "rows.csv", monkeypatch, speed)
        assert [line.decode() for line, _ in found] == text.split("\n")
        due = [0.0, *(at for _, at in rows), rows[-1][1]]
        assert [at for _, at in found] == pytest.approx([at / speed for at in due])

    @pytest.mark.parametrize(
        ("columns", "header", "times"),
        [
            (LogColumns(time="ms", time_unit="ms"), "A,ms", ("1000", "1500", "3000")),
            (LogColumns(separator="semicolon", decimal=",", time="T"), "A;T", ("1,0", "1,5", "3,0")),
            (
                LogColumns(time="UTC", time_unit="iso"),
                "A,UTC",
                tuple(f"2026-11-21T12:00:0{s}" for s in ("1", "1.5", "3")),
            ),
            (
                LogColumns(separator="tab", time=("D", "H"), time_unit="iso"),
                "A\tD\tH",
                tuple(f"2026-11-21\t12:00:0{s}" for s in ("1", "1.5", "3")),
            ),
        ],
    )
    def test_a_log_of_another_program(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, columns: LogColumns, header: str, times: tuple[str, ...]
    ) -> None:
        form = LogFormat({}, columns, "", ())
        rows = [f"48000{form.separator}{time}" for time in times]
        (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
        found = self.arrivals(tmp_path / "log.csv", monkeypatch, form=form)
        assert [at for _, at in found] == pytest.approx([0.0, 0.0, 0.5, 2.0])

    def test_a_file_that_is_not_there(self) -> None:
        with pytest.raises(InputError, match=r"nowhere\.csv does not exist, expected a readings file"):
            lines_at("replay:nowhere.csv")

    def test_an_empty_file(self, tmp_path: Path) -> None:
        (tmp_path / "empty.csv").touch()
        assert lines_at(f"replay:{tmp_path / 'empty.csv'}") == []


class TestStandardInput:
    def test_bytes_and_text(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for stdin in (io.TextIOWrapper(io.BytesIO(TEXT)), io.StringIO(TEXT.decode())):
            monkeypatch.setattr(sys, "stdin", stdin)
            assert lines_at("-") == LINES


@pytest.mark.parametrize(
    "address",
    [
        "",
        "x",
        "tcp",
        "tcp://",
        "tcp://host",
        "tcp://host:port",
        "udp://:9",
        "tcp://h:99999",
        "tcp://h:1/x",
        "http://h:1",
    ],
)
def test_no_address(address: str) -> None:
    with pytest.raises(InputError, match="found no"):
        lines_at(address)
