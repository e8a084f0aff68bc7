"""The daemon's event loop: what a signal to reload does, with a bus process that is only counted."""

import asyncio
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from same_thread import Immediate

from armlink import cli
from armlink.arm_file import bundled_arms, load_arm
from armlink.link.ends import EndCause
from armlink.link.types import Tell
from armlink.loop.kept_arm import KeptMessage
from armlink.loop.messages import Told
from calib.daemon import main_loop
from calib.daemon.main_loop import BEGIN_SECONDS, SILENT_SECONDS, Daemon, Notifier
from calib.daemon.settings import Options
from calib.records.file_lock import locked_directory


class NoProcess:
    """Stands for the bus process: a pipe that nothing comes through."""

    def __init__(self, arm: Any = None) -> None:
        self.arm, self.closed, self.killed = arm, False, False
        self.waiting: list[KeptMessage] = []
        self.pumped = 0
        self._ends = os.pipe()

    def fileno(self) -> int:
        return -1 if self.closed else self._ends[0]

    def pump(self) -> list[KeptMessage]:
        self.pumped += 1
        return self.waiting

    def kill(self) -> None:
        self.killed = True

    def close(self, cause: EndCause = EndCause.DONE, tell: Tell = lambda text: None) -> None:
        self.closed = True


class Running:
    """A daemon inside an event loop, on an arm file that can be changed."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.arm_file = folder / "arm.yaml"
        self.content = yaml.safe_load(bundled_arms()["sarcos"].read_text())
        self.write(lambda content: None)
        self.started: list[NoProcess] = []
        patch.setattr(Options, "keep", lambda options, arm: self._start(arm))
        patch.setattr(main_loop, "Worker", lambda *_: Immediate())
        options = Options(arm=str(self.arm_file), socket=folder / "api.sock", store=str(folder / "records.db"))
        self.process = NoProcess()
        self.daemon = Daemon(options, load_arm(self.arm_file), self.process, folder / "state")  # type: ignore[arg-type]

    def _start(self, arm: Any) -> NoProcess:
        self.started.append(NoProcess(arm))
        return self.started[-1]

    def write(self, change: Callable[[dict[str, Any]], None]) -> None:
        content = yaml.safe_load(yaml.safe_dump(self.content))
        change(content)
        self.arm_file.write_text(yaml.safe_dump(content))

    def kinds(self) -> list[str]:
        return [event.kind for event in self.daemon.service.journal.events()]


def with_daemon(folder: Path, patch: pytest.MonkeyPatch, act: Callable[[Running], None]) -> None:
    async def main() -> None:
        running = Running(folder, patch)
        try:
            act(running)
        finally:
            running.daemon.service.close("end")

    asyncio.run(main())


def limit(key: str, value: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["link"]["joints"][2][key] = value

    return change


def observer(**thresholds: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["daemon"] = {"observer": thresholds}

    return change


def data_sheet(content: dict[str, Any]) -> None:
    content["link"]["joints"][2]["eds"] = "missing.eds"


@pytest.mark.parametrize(
    "change",
    [
        limit("max_velocity", float("inf")),
        limit("max_torque_rate", float("inf")),
        limit("max_velocity", 1e300),
        limit("max_torque_rate", 1e300),
        limit("max_torque", 1e6),
        data_sheet,
        observer(window=0),
        observer(still_band=-1.0),
    ],
)
def test_a_file_that_cannot_be_used_whole_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[dict[str, Any]], None]
) -> None:
    def act(running: Running) -> None:
        daemon, before = running.daemon, running.daemon.service.configuration
        arm, settings = before.arm, before.settings
        running.write(change)
        daemon._reload()
        assert running.kinds()[-1] == "refused"
        assert (before.arm, before.settings, daemon.arm) == (arm, settings, arm)
        assert not running.process.closed
        assert not running.started

    with_daemon(tmp_path, monkeypatch, act)


def test_an_observer_that_cannot_be_made_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def act(running: Running) -> None:
        daemon = running.daemon

        def renew() -> None:
            raise ValueError("no such observer")

        monkeypatch.setattr(daemon.service, "_renew", renew)
        before = daemon.service.configuration.settings
        running.write(observer(window=16))
        daemon._reload()
        assert running.kinds()[-1] == "refused"
        assert daemon.service.configuration.settings is before

    with_daemon(tmp_path, monkeypatch, act)


def test_other_limits_reach_a_new_bus_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def act(running: Running) -> None:
        running.write(limit("max_velocity", 0.3))
        running.daemon._reload()
        assert running.kinds()[-1] in ("configuration", "fault")
        assert running.process.closed
        assert [process.arm.link.joints[2].max_velocity for process in running.started] == [0.3]

    with_daemon(tmp_path, monkeypatch, act)


@pytest.mark.parametrize("failing", ["", "tried"])
def test_systemd_is_told_of_the_end_of_a_reload_whatever_happens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(1.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

        def act(running: Running) -> None:
            def fails() -> None:
                raise RuntimeError("unforeseen")

            if failing:
                monkeypatch.setattr(running.daemon, "_tried", fails)
                with pytest.raises(RuntimeError):
                    running.daemon._reload()
            else:
                running.daemon._reload()

        with_daemon(tmp_path, monkeypatch, act)
        assert receiver.recv(200).startswith(b"RELOADING=1\n")
        assert receiver.recv(200) == b"READY=1"


def test_what_systemd_s_socket_did_not_take_is_sent_later_and_only_the_newest_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "notify"
    monkeypatch.setenv("NOTIFY_SOCKET", str(path))
    notify = Notifier()
    for line in (
        "READY=1",
        "STATUS=starting",
        "WATCHDOG=1",
        "STATUS=observing",
        "RELOADING=1",
        "READY=1",
        "WATCHDOG=1",
    ):
        notify(line)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        receiver.settimeout(1.0)
        for _ in range(2):
            notify.flush()
        heard = [receiver.recv(200) for _ in range(4)]
        assert heard == [b"STATUS=observing", b"RELOADING=1", b"READY=1", b"WATCHDOG=1"]
        receiver.setblocking(False)
        with pytest.raises(BlockingIOError):
            receiver.recv(200)


@pytest.mark.parametrize(("waiting", "stood_still"), [([Told(0, "")], 0.0), ([], 20.0)])
def test_a_service_that_stood_still_does_not_judge_its_bus_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waiting: list[KeptMessage], stood_still: float
) -> None:
    def act(running: Running) -> None:
        daemon, now = running.daemon, time.monotonic()
        running.process.waiting, daemon._heard = waiting, now - SILENT_SECONDS - 5.0
        daemon._judge(now, stood_still)
        assert not running.process.closed

    with_daemon(tmp_path, monkeypatch, act)


@pytest.mark.parametrize("at_its_end", ["_ended", "_replacing"])
def test_a_bus_process_that_parks_its_arm_for_long_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_its_end: str
) -> None:
    """Neither killed nor heard: the thread that sees it to its end reads the channel."""

    def act(running: Running) -> None:
        daemon = running.daemon
        if at_its_end == "_ended":
            daemon._ended.set()
        else:
            daemon._replacing = True
        for seconds in (1.0, SILENT_SECONDS + 1.0, 100.0):
            daemon._judge(time.monotonic() + seconds + BEGIN_SECONDS, 0.0)
        assert not running.process.killed
        assert not running.process.pumped
        assert not running.started

    with_daemon(tmp_path, monkeypatch, act)


def test_a_bus_process_that_hangs_is_replaced_and_again_where_there_is_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def act(running: Running) -> None:
        daemon = running.daemon

        def none_left(options: object, arm: object) -> None:
            raise BlockingIOError("Resource temporarily unavailable")

        with monkeypatch.context() as patch:
            patch.setattr(Options, "keep", none_left)
            daemon._heard = time.monotonic() - SILENT_SECONDS - 5.0
            daemon._judge(time.monotonic(), 0.0)
            assert running.process.killed
            assert running.process.closed
            assert not running.started
        daemon._judge(time.monotonic() + SILENT_SECONDS, 0.0)
        assert len(running.started) == 1
        daemon._judge(time.monotonic() + BEGIN_SECONDS, 0.0)
        assert len(running.started) == 1

    with_daemon(tmp_path, monkeypatch, act)


def test_a_second_daemon_on_a_state_directory_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It neither opens the bus nor touches the first one's journal."""
    begun: list[object] = []
    monkeypatch.setattr("calib.commands.daemon.TAKE_OVER_SECONDS", 0.0)
    monkeypatch.setattr("calib.daemon.logs.log_to_stderr", lambda: None)
    monkeypatch.setattr(Options, "keep", lambda *given: begun.append(given))
    with locked_directory(tmp_path, "--state of the first"):
        status = cli.run(["daemon", "sarcos", "--bus", "armlink_sim:sarcos", "--state", str(tmp_path)])
    error = capsys.readouterr().err
    assert status == 2
    assert f"--state {tmp_path}: in use by" in error
    assert f"(process {os.getpid()}): stop that process, or choose another one" in error.replace("\n", " ")
    assert begun == []
    assert not (tmp_path / "journal.db").exists()
