"""Before a sweep: sensors, temperatures and stops of a simulated arm, each trouble named with its joint."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_arm import along, bench, post
from hard_cases import stick
from sweep_arms import random_arm

from armlink.arm_file import ArmFile, load_arm
from armlink.cli import run
from armlink.drives.canopen.settings import CanopenSettings
from armlink.errors import Refused
from armlink.link.link import Link
from calib.arm.kinematics import DriveLimits
from calib.motion.encoder_check import EncoderFault
from calib.motion.mover import Mover, Stalled
from calib.plan.collisions import Geometry
from calib.plan.drawing import stops_seconds
from calib.sweep.preflight import HOT, Preflight, find_stops, listen
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.sim_section import EffectEntry
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ARM = random_arm(31, 2)
RATED = float(DriveLimits.of(ARM).rated[1])


@contextmanager
def enabled(simulated: SimulatedArm, arm: ArmFile = ARM) -> Iterator[Link]:
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        yield link


def trouble(name: str, **values: Any) -> SimulatedArm:
    simulated = SimulatedArm(ARM, Truth.draw(ARM, 1), 1)
    simulated.set_effects([*simulated.effects, EffectEntry(effect=name, joint="j2", **values)])
    return simulated


def test_noise_is_measured_and_the_drives_are_cool() -> None:
    simulated = SimulatedArm(ARM, Truth.draw(ARM, 1), 1)
    with enabled(simulated) as link:
        found = listen(link, ARM)
    assert found.noise == pytest.approx(simulated.sensors.noise / simulated.sensors.gain, rel=0.3)
    assert found.temperature == pytest.approx([31.0, 31.0])


def test_a_hot_drive_is_named() -> None:
    simulated = SimulatedArm(ARM, Truth.of(ARM), 1)
    simulated.nodes[1].identity[0x2101, 0] = round(10 * HOT) + 5
    simulated.reboot(1)
    with enabled(simulated) as link, pytest.raises(Refused, match=r"j2: its drive is at 7\d °C, .*let it cool down"):
        listen(link, ARM)


def test_a_drive_without_a_thermometer_is_not_judged() -> None:
    simulated = SimulatedArm(ARM, Truth.of(ARM), 1)
    with enabled(simulated) as link:
        del (
            link.groups[0].drives.services(link.ask)[0].remote.object_dictionary[0x2101]
        )  # the sheet that both joints have
        found = listen(link, ARM)
    assert np.isnan(found.temperature).all()


def test_a_sensor_at_the_end_of_its_range_is_named() -> None:
    with enabled(trouble("torque.offset", offset=3 * RATED)) as link, pytest.raises(Refused, match=r"j2: .* near the"):
        listen(link, ARM)


def test_a_loud_sensor_is_named() -> None:
    sensors = ARM.sim.sensors.model_copy(update={"noise": (0.01, 0.08 * RATED)})
    loud = ARM.model_copy(update={"sim": ARM.sim.model_copy(update={"sensors": sensors})})
    with (
        enabled(SimulatedArm(loud, Truth.of(loud), 1)) as link,
        pytest.raises(Refused, match="j2: the noise of its torque sensor is"),
    ):
        listen(link, ARM)


def test_a_silent_sensor_is_named() -> None:
    with enabled(SimulatedArm(ARM, Truth.of(ARM), 1)) as link:
        whole = link.cycle

        def deaf(command: Any) -> Any:
            sample = whole(command)
            return replace(sample, torque=np.array([sample.torque[0], np.nan]))

        link.cycle = deaf  # type: ignore[method-assign]
        with pytest.raises(Refused, match=r"j2: \d+ of \d+ torque readings are missing"):
            listen(link, ARM)


@pytest.mark.parametrize("mute", [False, True])
def test_a_drives_own_torque_in_every_fourth_cycle_is_no_loss(mute: bool) -> None:
    """6077h of a CiA 402 drive comes in TPDO2; where it does not come at all, it is missing."""
    rows = [row.model_copy(update={"node": None, "drive": motor(row.node)}) for row in ARM.link.joints]
    arm = ARM.model_copy(update={"link": ARM.link.model_copy(update={"joints": tuple(rows)})})
    with enabled(SimulatedArm(arm, Truth.of(arm), 1), arm) as link:
        whole = link.cycle

        def deaf(command: Any) -> Any:
            sample = whole(command)
            return replace(sample, torque=np.array([sample.torque[0], np.nan]))

        if mute:
            link.cycle = deaf  # type: ignore[method-assign]
            with pytest.raises(Refused, match=r"j2: (\d+) of \1 torque readings are missing"):
                listen(link, arm)
        else:
            assert np.isfinite(listen(link, arm).torque).all()


def motor(node: int | None) -> CanopenSettings:
    return CanopenSettings(node=node, torque="motor")


def test_stops_are_found_where_the_arm_file_has_them_and_named_where_not() -> None:
    simulated = SimulatedArm(ARM, Truth.draw(ARM, 1), 1)
    rows = list(ARM.kinematics.joints)
    rows[1] = rows[1].model_copy(update={"upper": rows[1].upper + 0.2})
    wider = ARM.model_copy(update={"kinematics": ARM.kinematics.model_copy(update={"joints": tuple(rows)})})
    counted = []
    with enabled(simulated) as link:
        listened, begun = listen(link, ARM), simulated.time
        found = find_stops(link, ARM, listened, lambda done, total: counted.append((done, total)))
        limits = DriveLimits.of(ARM)
        reading = (np.column_stack([limits.lower, limits.upper])) / simulated.truth.position_gain[:, None]
        np.testing.assert_allclose(found.stops, reading, atol=0.004)
        assert counted[-1] == (4, 4)
        assert simulated.time - begun == pytest.approx(stops_seconds(ARM), rel=0.25)
        with pytest.raises(Refused, match=r"j2 was blocked at .* its stop should be at"):
            find_stops(link, wider, listened)


def test_a_stop_on_whose_way_bodies_touch_is_left_out(tmp_path: Path) -> None:
    """The arm, stretched out, meets the post on the shoulder's way up."""
    found, clear = searched(simulated_bench(tmp_path, post(0.3, 0.3)))
    np.testing.assert_allclose(found.stops, [[np.nan, 1.2], [-1.5, 1.5]], atol=0.01)
    assert clear
    assert found.left_out == (
        "not pushed, since bodies of the model would touch on the way: the lower stop of shoulder",
    )


def simulated_bench(folder: Path, obstacle: str) -> ArmFile:
    (folder / "simulated.yaml").write_text(f"{Path(bench(folder, obstacle).path).read_text()}sim: {{}}")
    return load_arm(str(folder / "simulated.yaml"))


def searched(arm: ArmFile) -> tuple[Preflight, bool]:
    """What the search for stops found, and whether all its commands were clear of the model's shapes."""
    geometry, commanded = Geometry(arm), list[np.ndarray]()
    with enabled(SimulatedArm(arm, Truth.of(arm), 1), arm) as link:
        listened, whole, sent_ahead = listen(link, arm), link.cycle, link.play

        def noted(command: Any) -> Any:
            commanded.append(command.position.copy())
            return whole(command)

        def played(setpoints: Any) -> Any:
            commanded.extend(setpoints.position)
            return sent_ahead(setpoints)

        link.cycle, link.play = noted, played  # type: ignore[method-assign]
        found = find_stops(link, arm, listened)
    return found, bool(geometry.free(np.array(commanded)[::20]).all())


def test_after_a_joint_that_does_not_get_there_no_way_leads_through_what_stands_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The elbow is bent on the way there; the way to the middle would lead the stretched arm through the post."""
    touch = Mover.touch

    def weak(mover: Mover, stops: Any) -> Any:
        if stops[0] < 0:
            raise Stalled("shoulder", 0.0, 0.0, 0)
        return touch(mover, stops)

    monkeypatch.setattr(Mover, "touch", weak)
    found, clear = searched(simulated_bench(tmp_path, post(*along(-0.4, 0.0, 1.13), half=0.02)))
    assert clear
    assert found.left_out == (
        "not pushed, since the joint did not get there: the lower stop of shoulder",
        "not pushed, since bodies of the model would touch on the way: the upper stop of shoulder",
    )


def test_the_command_names_the_stops_that_it_left_out_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ended(*_: Any, **__: Any) -> Any:
        raise Refused("enough")

    monkeypatch.setattr("calib.sweep.run.run_sweep", ended)
    simulated_bench(tmp_path, post(0.3, 0.3))
    out = str(tmp_path / "out")
    assert run(["sweep", str(tmp_path / "simulated.yaml"), "--dry-run", "--check-stops", "--out", out]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("bodies of the model would touch on the way: the lower stop of shoulder") == 1


def test_a_stuck_encoder_bit_is_named_before_any_stop_is_pressed() -> None:
    simulated = SimulatedArm(ARM, Truth.draw(ARM, 1), 1)
    stick(simulated, 6)
    with enabled(simulated) as link:
        found = listen(link, ARM)
        with pytest.raises(EncoderFault, match=r"^j2: .*its position reading .*the encoder, since its bit 6 is stuck"):
            find_stops(link, ARM, found)
