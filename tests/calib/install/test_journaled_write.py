"""Writing to controllers: gates, each pair read back, a check motion; put back where that is worse or was cut off."""

import contextlib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from fake_controllers import ARM, NAMES, Controllers, joint, record

from armlink.arm_file import load_arm
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.types import Calibration
from calib.arm.kinematics import DriveLimits
from calib.install.check_motion import CheckMotion, check_poses
from calib.install.journaled_write import install, recover
from calib.install.plausibility import Admitted, admit, check_bounds, check_change, history_std, past_changes
from calib.observer.recalibrator import ROWS, AfterWrite
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

NEW = record(joints=(joint("shoulder", 1.15, 0.2), joint("elbow", 0.95, -0.1)), note="new")


class Killed(BaseException):
    """The process is no more: nothing runs after it."""


class Dying(Controllers):
    """Controllers whose host is killed at the k-th access; what they hold stays."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.left = at

    def access(self) -> None:
        if self.left == 0:
            raise Killed
        self.left -= 1

    def read_calibration(self, joint: int) -> Calibration:
        self.access()
        return super().read_calibration(joint)

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        self.access()
        return super().write_calibration(joint, calibration, store)


def admitted(new: CalibrationRecord = NEW) -> Admitted:
    """Past the gates, as if every sensor had been exchanged."""
    return Admitted(new, ARM, "none")


def pairs(controllers: Controllers) -> list[tuple[float, float]]:
    return [(round(held.gain, 6), round(held.offset, 6)) for held in controllers.held]


OLD_PAIRS, NEW_PAIRS = [(1.1, -0.4)] * 2, [(1.15, 0.2), (0.95, -0.1)]


def test_a_write_is_noted_written_and_current(store: RecordStore) -> None:
    controllers = Controllers()
    assert install(admitted(), store, controllers, by="ann", reason="sweeps", check=None) == NAMES
    assert pairs(controllers) == NEW_PAIRS
    assert [held.record_id for held in controllers.held] == [NEW.number] * 2
    assert store.current(CalibrationRecord, ARM) == NEW
    begun, finished = store.writes(ARM)
    assert (begun.stage, finished.stage) == ("begun", "finished")
    assert [entry["name"] for entry in begun.body["before"]] == list(NAMES)
    assert store.unfinished_write(ARM) is None


@pytest.mark.parametrize("at", range(8))
def test_killed_at_any_access_the_next_start_finds_old_or_new_and_nothing_between(store: RecordStore, at: int) -> None:
    controllers = Dying(at)
    with contextlib.suppress(Killed):
        install(admitted(), store, controllers, by="ann", reason="sweeps", check=None)
    controllers.left = -1  # powered and running all the while
    recover(ARM, store, controllers)
    current = store.current(CalibrationRecord, ARM)
    assert pairs(controllers) == (NEW_PAIRS if current == NEW else OLD_PAIRS)
    assert current in (NEW, record())
    assert store.unfinished_write(ARM) is None
    install(admitted(), store, controllers, by="ann", reason="again", check=None)
    assert pairs(controllers) == NEW_PAIRS


def test_what_is_worse_afterwards_is_put_back(store: RecordStore) -> None:
    controllers = Controllers()
    with pytest.raises(Refused, match="elbow fits worse: the old calibration was written back to the drives"):
        install(admitted(), store, controllers, by="ann", reason="sweeps", check=lambda: "elbow fits worse")
    assert pairs(controllers) == OLD_PAIRS
    assert store.current(CalibrationRecord, ARM) == record()
    assert NEW in store.history(ARM)
    assert store.writes(ARM)[-1].stage == "undone"


def test_a_controller_that_fails_half_way_leaves_none_with_the_new_pair(store: RecordStore) -> None:
    class Failing(Controllers):
        def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
            if joint == 1 and calibration.gain == 0.95:
                raise BusFault("elbow: read back other bits than written")
            return super().write_calibration(joint, calibration, store)

    controllers = Failing()
    with pytest.raises(BusFault, match="read back"):
        install(admitted(), store, controllers, by="ann", reason="sweeps", check=None)
    assert pairs(controllers) == OLD_PAIRS
    assert store.current(CalibrationRecord, ARM) == record()


def test_flash_is_written_on_request_only_and_after_the_check(store: RecordStore) -> None:
    seen: list[str] = []

    class Watched(Controllers):
        def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
            seen.append("flash" if store else "active")
            return super().write_calibration(joint, calibration, store)

    install(admitted(), store, Watched(), by="ann", reason="sweeps", check=None)
    assert seen == ["active"] * 2
    seen.clear()
    install(admitted(record()), store, Watched(), by="ann", reason="x", flash=True, check=lambda: seen.append("check"))  # type: ignore[func-returns-value]
    assert seen == ["active", "active", "check", "flash", "flash"]


def test_mending_leaves_what_somebody_else_wrote_since(store: RecordStore) -> None:
    controllers = Dying(3)
    with pytest.raises(Killed):
        install(admitted(), store, controllers, by="ann", reason="sweeps", check=None)
    controllers.left = -1
    controllers.held[0] = Calibration(0.8, 0.5, 99, 0, 0)
    assert recover(ARM, store, controllers) is not None
    assert pairs(controllers) == [(0.8, 0.5), (1.1, -0.4)]
    assert "shoulder got another calibration since" in store.writes(ARM)[-1].body["reason"]


# ---- gates


@pytest.mark.parametrize(
    ("joints", "said"),
    [
        ((joint("shoulder", 2.3, 0.0), joint("elbow")), r"shoulder: gain 2\.3000 is not between 0\.5 and 2"),
        ((joint("shoulder"), joint("elbow", 1.1, 26.0)), r"elbow: offset 26\.000 N·m is beyond ± 25"),
        ((joint("shoulder", -1.0), joint("elbow")), r"shoulder: gain -1\.0000"),
    ],
)
def test_values_that_no_sensor_has_are_refused(joints: tuple[JointCalibration, ...], said: str) -> None:
    with pytest.raises(Refused, match=said):
        check_bounds(record(joints=joints), ARM)


def test_a_change_beyond_covariance_and_history_is_refused_unless_the_sensor_was_exchanged(store: RecordStore) -> None:
    past = past_changes(store, ARM)
    check_change(record(joints=(joint("shoulder", 1.1 * 1.08), joint("elbow"))), record(), past, ARM)
    jump = record(joints=(joint("shoulder", 1.1 * 1.12), joint("elbow")))
    with pytest.raises(Refused, match=r"shoulder: gain 1\.2320 differs by \+12\.0% from record"):
        check_change(jump, record(), past, ARM)
    check_change(jump, record(), past, ARM, replaced=["shoulder"])
    with pytest.raises(Refused, match="of rated torque from record"):
        check_change(record(joints=(joint("shoulder"), joint("elbow", 1.1, 6.0))), record(), past, ARM)


def test_a_quiet_history_allows_less_and_an_unsure_record_more(store: RecordStore) -> None:
    for k in range(12):
        store.put(record(note=str(k)), ARM, by="ann", reason="sweep")
    past = past_changes(store, ARM)
    assert past["gain"].shape == (12, 2)
    assert history_std(past["gain"], 0.02)[0] == pytest.approx(0.01)  # √(4·0.02²/16)
    jump = record(joints=(joint("shoulder", 1.1 * 1.08), joint("elbow")))
    with pytest.raises(Refused, match=r"covariance and history allow only 5\.0%"):
        check_change(jump, record(), past, ARM)
    unsure = jump.model_copy(update={"covariance": matrix(np.diag([0.03**2, 1e-4, 1e-6, 1e-4]))})
    check_change(unsure, record(), past, ARM)


# ---- the check motion on the simulated arm


@pytest.fixture(scope="module")
def simulated() -> SimulatedArm:
    arm = load_arm("sarcos")
    arm = arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": 50.0})})
    return SimulatedArm(arm, Truth.draw(arm, 3), 3)


def true_record(arm_sim: SimulatedArm, **wrong: float) -> CalibrationRecord:
    """The sensors as they truly are, except `joint_k` whose gain is wrong by a factor."""
    truth, arm = arm_sim.true_sensors, arm_sim.arm
    joints = tuple(
        JointCalibration(
            name=name,
            gain=float(truth.gain[j]) * wrong.get(name, 1.0),
            offset=float(truth.offset[j]),
            position_gain=float(truth.position_gain[j]),
            position_offset=float(truth.position_offset[j]),
        )
        for j, name in enumerate(arm.joint_names)
    )
    return CalibrationRecord(**provenance(arm), joints=joints)


def true_beta(arm_sim: SimulatedArm) -> np.ndarray:
    """Mass moments from the simulated arm's own torques at random poses, by linear least squares."""
    from calib.arm.kinematics import gcomp_arm
    from gcomp.gravity.torque import gravity_regressor

    described = gcomp_arm(arm_sim.arm)
    q = np.random.default_rng(0).uniform(described.lower, described.upper, (40, described.n))
    regressor = gravity_regressor(described, q).reshape(-1, 2 * described.n)
    return np.linalg.lstsq(regressor, arm_sim.gravity_torque(q).ravel(), rcond=None)[0]


def test_a_motion_proves_a_right_record_and_takes_a_worse_one_back(simulated: SimulatedArm, tmp_path: Path) -> None:
    """True pairs come into force; then a gain wrong by 4 % is written, shows in the motion and is put back."""
    arm, beta = simulated.arm, true_beta(simulated)
    store = RecordStore(str(tmp_path / "records.db"))
    right, wrong = true_record(simulated), true_record(simulated, joint_2=1.04)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        begin = link.enable().position
        motion = CheckMotion(link, arm, right, beta)
        motion.before()
        assert len(install(admit(right, arm, store), store, link, by="ann", reason="sweeps", check=motion.after)) == 7
        again = CheckMotion(link, arm, wrong, beta)
        again.before()
        with pytest.raises(Refused, match=r"joint_2: in the check motion the RMS difference to the model is"):
            install(admit(wrong, arm, store), store, link, by="ann", reason="sweeps", check=again.after)
        held = [link.read_calibration(j) for j in range(link.n)]
        assert [each.gain for each in held] == pytest.approx(right.values("gain").tolist(), rel=1e-6)
        assert [each.record_id for each in held] == [right.number] * 7
        np.testing.assert_allclose(link.position_sent, begin, atol=0.01)
    assert store.current(CalibrationRecord, arm) == right


def test_a_controller_that_does_not_use_its_new_pair_is_found(simulated: SimulatedArm) -> None:
    """Without a gravity model too: readings are not what the new pair makes of the old ones."""

    class Lying(Link):
        def read_calibration(self, joint: int) -> Calibration:
            held = super().read_calibration(joint)
            return held if joint or not self.claimed else Calibration(held.gain, held.offset + 3.0, 1, 0, 0)

        claimed = False

    with Lying(simulated.arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        motion = CheckMotion(link, simulated.arm, true_record(simulated), None)
        motion.before()
        assert motion.after() is None
        gain = link.read_calibration(0).gain
        link.claimed = True
        complaint = str(motion.after())
        assert complaint.startswith("joint_1: its readings after the write are ")
        assert float(complaint.split()[7]) == pytest.approx(3.0 / gain, abs=0.05)


def test_check_poses_are_near_off_the_stops_and_move_every_joint_both_ways() -> None:
    limits = DriveLimits.of(load_arm("sarcos"))
    for begin in ((limits.lower + limits.upper) / 2, limits.lower.copy(), limits.upper.copy()):
        poses = check_poses(begin, limits)
        assert (poses > limits.lower).all()
        assert (poses < limits.upper).all()
        assert np.abs(poses - begin).max() <= 0.2 + 1e-9
    middle = (limits.lower + limits.upper) / 2
    moved = check_poses(middle, limits) - middle
    assert (moved.max(axis=0) > 0.1).all()
    assert (moved.min(axis=0) < -0.1).all()


# ---- after a recalibration in the field


@pytest.mark.parametrize(("truly", "verdict"), [(1.03, "kept"), (1.0, "worse")])
def test_rests_after_a_recalibration_tell_whether_it_was_right(truly: float, verdict: str) -> None:
    """The elbow's gain was raised by 3 %: right where it had drifted, worse where it had not."""
    random = np.random.default_rng(1)
    gravity = GravityRecord(
        **provenance(ARM, created=datetime(2026, 11, 21, tzinfo=UTC)),
        names=NAMES,
        beta=(2.0, 0.5, 1.5, 0.2),
        covariance=matrix(np.zeros((4, 4))),
        identifiable=(True,) * 4,
        gravity=(0.0, -9.81, 0.0),
    )
    old, new = Calibration(1.1, -0.4, 1, 0, 0), Calibration(1.1 * 1.03, -0.4, 2, 0, 0)
    arm = ARM.model_copy(update={"kinematics": ARM.kinematics.model_copy(update={"gravity": (0.0, -9.81, 0.0)})})
    gravity = gravity.model_copy(update={"description_hash": arm.description_hash})
    check = AfterWrite(arm, gravity, record(), {1: old}, {1: new})
    from calib.arm.kinematics import gcomp_arm
    from gcomp.gravity.torque import gravity_torque

    t, outcome = 0.0, None
    for _ in range(ROWS):
        assert outcome is None
        pose = random.uniform(-1, 1, 2)
        true = gravity_torque(gcomp_arm(arm), np.array(gravity.beta), pose[None])[0]
        raw = 1.1 * truly * true[1] - 0.4
        sent = np.array([true[0], (raw - new.offset) / new.gain])
        for _ in range(120):
            t += 0.004
            outcome = check.handle(t, pose, sent + random.normal(0, 0.1, 2)) or outcome
    assert outcome is not None
    assert (outcome.verdict, outcome.joint) == (verdict, 1)
