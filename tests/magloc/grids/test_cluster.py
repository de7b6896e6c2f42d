"""Maps on a dask cluster: the same values, and what happens when the cluster is not there or goes away."""

from __future__ import annotations

import gc
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
import xarray as xr

from arrays.io.errors import InputError
from magloc.cli.app import main
from magloc.convergence.filters import DampedFilter, IekfFilter
from magloc.convergence.over_starts import StartsMap, StartsScenario
from magloc.grids.cluster import check_address, worked_by
from magloc.grids.cube import boxes, computed, in_memory
from magloc.grids.store import Sweep, open_map
from magloc.grids.work import workers
from tests.conftest import REPOSITORY
from tests.magloc.grids.test_work import ITEMS, squared

pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
ROLES = ("client", "scheduler", "worker")


@pytest.fixture(scope="module")
def cube():
    """Of 27 chunks."""
    return StartsMap.of(StartsScenario(method=DampedFilter(max_iterations=6000)), 40)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler with two workers on this machine, and its process; one for all tests."""
    tmp_path = tmp_path_factory.mktemp("cluster")
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    address_file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    quiet["env"] = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    here = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(address_file)]
    scheduler = subprocess.Popen([*dask, *here, "--port", "0"], **quiet)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-dashboard", "--nworkers", "2"]
    worker += ["--nthreads", "1", "--scheduler-file", str(address_file)]
    workers = subprocess.Popen([*worker, "--host", "127.0.0.1"], **quiet)
    try:
        yield wait_for_address(address_file), scheduler
    finally:
        scheduler.kill()
        workers.terminate()
        workers.wait()
        scheduler.wait()


def wait_for_address(path):
    for _ in range(1000):
        try:
            return json.loads(path.read_text())["address"]
        except (OSError, ValueError):
            time.sleep(0.02)
    raise TimeoutError(f"{path} was not written")


@pytest.fixture(scope="module")
def tls(tmp_path_factory):
    """dask's configuration."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs openssl to make a certificate")
    key, certificate = (str(tmp_path_factory.getbasetemp() / name) for name in ("key.pem", "cert.pem"))
    command = [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-keyout", key, "-out", certificate, "-days", "1", "-subj", "/CN=magloc"]
    subprocess.run(command, check=True, capture_output=True)
    files = {f"{role}.{part}": file for role in ROLES for part, file in (("cert", certificate), ("key", key))}
    return {"distributed.comm.require-encryption": True} | {
        f"distributed.comm.tls.{name}": file for name, file in {"ca-file": certificate, **files}.items()
    }


@pytest.fixture(scope="module")
def tls_scheduler(tls):
    from distributed import LocalCluster, Security

    with dask.config.set(tls):
        security = Security()
    here = {"host": "127.0.0.1", "dashboard_address": None, "processes": False, "n_workers": 1}
    # Else the scheduler asks for one port, and warns if it is taken.
    here["scheduler_kwargs"] = {"dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**here, threads_per_worker=1, protocol="tls://", security=security) as cluster:
        yield cluster.scheduler_address


class TestCluster:
    @pytest.mark.slow
    def test_command(self, cluster, tmp_path, capsys):
        address, _ = cluster
        arguments = ["map", "--over", "sources", "--grid", "7", "--quiet"]
        assert main([*arguments, "--scheduler", address, "--out", str(tmp_path / "far")]) == 0
        assert main([*arguments, "--out", str(tmp_path / "here")]) == 0
        assert capsys.readouterr().err == ""
        with (
            open_map(tmp_path / "far/map.zarr") as far,
            open_map(tmp_path / "here/map.zarr") as here,
        ):
            xr.testing.assert_equal(far, here)

    @pytest.mark.slow
    def test_other_work(self, cluster):
        """Of a survey's tiles, for instance."""
        with workers(1, cluster[0], None) as each:
            done = dict(each(squared, ITEMS))
        for number, item in enumerate(ITEMS):
            np.testing.assert_array_equal(done[number]["square"], item**2)

    @pytest.mark.slow
    def test_a_worker_that_fails(self, cluster, cube):
        address, _ = cluster
        broken = StartsMap(cube.scenario, cube.grid, None, cube.z, cube.optimum)
        with pytest.raises(InputError, match=r"a worker failed: AttributeError\("):
            list(worked_by(address, partial(computed, broken), boxes(cube)))

    @pytest.mark.slow
    def test_same_values_and_then_death(self, cluster, tmp_path, cube):
        """The last one: it ends the scheduler."""
        address, scheduler = cluster
        path = tmp_path / "map.zarr"

        def until_the_scheduler_dies():
            for i, chunk in enumerate(worked_by(address, partial(computed, cube), sweep.unfinished())):
                if i == 6:
                    scheduler.kill()
                yield chunk

        with Sweep(cube, path) as sweep:
            with pytest.raises(InputError, match=f"scheduler {address}: the connection to the scheduler was lost"):
                sweep.write(until_the_scheduler_dies())
            by_workers = sweep.chunks_done
        assert 7 <= by_workers < 27
        marks = marks_of(path)
        assert len(marks) == by_workers
        with Sweep(cube, path) as sweep:
            sweep.write(map(partial(computed, cube), sweep.unfinished()))
        assert {mark: written for mark, written in marks_of(path).items() if mark in marks} == marks
        expected = in_memory(cube)
        with open_map(path) as stored:
            for name in expected:
                np.testing.assert_array_equal(stored[name], expected[name])


class TestTls:
    """Scheduler, workers and we show each other certificates, of which each machine has the same here."""

    def test_same_values(self, tls_scheduler, tls):
        assert tls_scheduler.startswith("tls://127.0.0.1:")
        cube = StartsMap.of(StartsScenario(method=IekfFilter(max_iterations=5)), 5)
        with dask.config.set(tls):
            (chunk,) = worked_by(tls_scheduler, partial(computed, cube), boxes(cube))
        (expected,) = map(partial(computed, cube), boxes(cube))
        for name, values in expected.values.items():
            np.testing.assert_array_equal(chunk.values[name], values)

    def test_nobody_without_a_certificate(self, tls_scheduler, cube):
        with pytest.raises(InputError, match="found no certificates, expected some in dask's"):
            list(worked_by(tls_scheduler, partial(computed, cube), boxes(cube)))
        plain = tls_scheduler.replace("tls:", "tcp:")
        with pytest.raises(InputError, match=f"scheduler {plain}: found (no scheduler|another service) there"):
            list(worked_by(plain, partial(computed, cube), boxes(cube), timeout_s=2.0))

    def test_certificates_that_are_not_there(self, tls_scheduler, tls, tmp_path, cube):
        wrong = tls | {"distributed.comm.tls.ca-file": str(tmp_path / "none.pem")}
        with dask.config.set(wrong), pytest.raises(InputError, match="dask's certificates cannot be read"):
            list(worked_by(tls_scheduler, partial(computed, cube), boxes(cube)))


class TestNoCluster:
    def test_nobody_there(self, cube):
        with pytest.raises(InputError, match=r"scheduler tcp://127\.0\.0\.1:9: found no scheduler there"):
            list(worked_by("tcp://127.0.0.1:9", partial(computed, cube), boxes(cube), timeout_s=0.2))

    @pytest.mark.parametrize("address", ["foo", "nonsense:::", "", "http://x", "tcp://x", "x:0", "x:65536", "a b:1"])
    def test_not_an_address(self, address, tmp_path, capsys):
        """Refused before anything is written."""
        out = tmp_path / "map"
        assert main(["map", "--grid", "3", "--scheduler", address, "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line == f"magloc: --scheduler: found {address!r}, expected tcp://HOST:PORT or HOST:PORT."
        assert not out.exists()

    @pytest.mark.parametrize("address", ["127.0.0.1:8786", "tcp://h.example:1", "tls://h:65535", "tcp://[::1]:8786"])
    def test_addresses(self, address):
        check_address(address)

    @pytest.mark.parametrize("answer", [b"HTTP/1.0 400 Bad Request\r\n\r\n", b"", None])
    @pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
    def test_another_service_there(self, answer, cube):
        """It answers, hangs up, or says nothing: one error, and no client that complains when it is deleted."""
        with socket.create_server(("127.0.0.1", 0)) as server:

            def serve():
                connection, _ = server.accept()
                with connection:
                    connection.sendall(answer)

            if answer is not None:
                threading.Thread(target=serve, daemon=True).start()
            address = "{}:{}".format(*server.getsockname())
            # Dask's own patience is without end: what ends the wait is the time that was given.
            with (
                dask.config.set({f"distributed.comm.timeouts.{name}": "1 day" for name in ("connect", "tcp")}),
                pytest.raises(InputError, match=f"scheduler {address}: found (no scheduler|another service) there"),
            ):
                list(worked_by(address, partial(computed, cube), boxes(cube), timeout_s=0.3))
            gc.collect()

    def test_not_installed(self, monkeypatch, cube):
        monkeypatch.setitem(sys.modules, "distributed", None)
        with pytest.raises(InputError, match=r'needs the extra "cluster": pip install "magloc\[cluster\]"'):
            list(worked_by("tcp://127.0.0.1:9", partial(computed, cube), boxes(cube)))


def marks_of(path):
    return {p: p.stat().st_mtime_ns for p in (path / "seconds_of_chunk" / "c").rglob("*") if p.is_file()}


def test_commands_in_pages_listen_to_this_machine_or_ask_for_certificates():
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages).replace("\\\n", "")
    commands = re.findall(r"^ {4}dask (?:scheduler|worker) .*$", text, re.MULTILINE)
    assert len(commands) >= 4  # scheduler and worker, on one machine and on several
    for command in commands:
        assert "--host 127.0.0.1 " in command or "--protocol tls " in command, command
        assert "--dashboard-address 127.0.0.1:" in command, command
