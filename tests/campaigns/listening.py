"""Campaign: minutes beside programs that command an arm, ROS 2 over DDS and a LeRobot-like loop on a servo line.

    python tests/campaigns/listening.py [--minutes 10] [--only ros2|lerobot] [--out DIR]

Each program commands a simulated arm in real time: one is its host and publishes sensor_msgs/JointState through plain
CycloneDDS, the other reads and writes servos on a pseudo-terminal by Feetech's SDK. It runs four times, each for a
quarter of the time: alone; then with `armlink record` beside it, with the arm as it should be, with 0.3 kg in its hand,
and with a torque constant 5 % off. `armlink gap diagnose` then says what each recording has.

Prints a line for each run. Exit status 1 if the program's median pass is later by more than 1 ms with a listener, if
another than the program writes in the domain or on the servo line, or if a change is not found or a sound arm is not.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent.parent / "armlink"))
from servo_bench import ServoBench

from armlink.arm_file import ArmFile, load_arm
from armlink.arrays import Array
from armlink.bus.listening.servo_lines import MODELS
from armlink.link.link import Link
from armlink.link.types import Command, Sample
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import WorkMotion, work_targets
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

RUNS = ("alone", "sound", "payload", "constant")
PAYLOAD, CONSTANT, JOINT = 0.3, 1.05, "shoulder"
"""Mass in the hand [kg], and factor on the torque reading of a joint."""
LATER_MS = 1.0
"""Most by which the median pass may be later with a listener [ms]."""
TOLERANCE = 0.3
"""Share by which the mass and the change that are found may be off."""
ARM, DOMAIN, TOPIC = "six-damiao", "87", "/joint_states"
HOST_HZ = 100.0
"""Cycles of the simulated arm's own host, and messages a second."""
LOOP_HZ = 30.0
"""Passes of the LeRobot-like loop a second, as LeRobot's own."""
SERVOS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
SERVO, TORQUE_CONSTANT = MODELS["sts3215"], 2.0
"""Torque of this arm's joints by current [N·m/A]."""
PATIENCE_MS = 5_000
"""Servos that are a program on a busy machine may answer later than the SDK's 40 ms."""
CYCLONEDDS = (
    "<Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General></Domain>"
)


def hosted_arm() -> ArmFile:
    """The simulated arm, at the rate of its host here."""
    arm = load_arm(ARM)
    return arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": HOST_HZ})})


class HostedArm:
    """The simulated arm under its own host, led to targets no faster than its joints may turn."""

    def __init__(self, run: str) -> None:
        self.arm = hosted_arm()
        simulated = SimulatedArm(self.arm, Truth.of(self.arm), 1)
        if run == "payload":
            simulated.attach_mass(PAYLOAD)
        if run == "constant":
            simulated.drift(JOINT, CONSTANT, 0.0)
        self.link = Link(self.arm, LockStepBus(arm=simulated))
        self.link.start()
        self.sample: Sample = self.link.enable()
        self.target = self.sample.position.copy()
        self.step = 0.9 * self.link.period * np.array([joint.max_velocity for joint in self.arm.require_link().joints])

    def cycle(self, goal: Array) -> Sample:
        self.target += np.clip(goal - self.target, -self.step, self.step)
        self.sample = self.link.cycle(Command.hold(self.target))
        return self.sample

    def goals(self, period: float) -> Any:
        described = gcomp_arm(self.arm)
        speeds = np.array([joint.max_velocity for joint in self.arm.require_link().joints])
        random = np.random.default_rng(3)
        return work_targets(
            self.sample.position, described.lower, described.upper, 0.8 * speeds, period, random, WorkMotion()
        )


class Passes:
    """Passes of a program's loop: how late each began, and how long it took."""

    def __init__(self, rate: float, seconds: float) -> None:
        self._period, self._seconds = 1 / rate, seconds
        self.late, self.took, self.cpu = list[float](), list[float](), list[float]()

    def __iter__(self) -> Any:
        due = time.perf_counter()
        end = due + self._seconds
        while due < end:
            due += self._period
            time.sleep(max(due - time.perf_counter(), 0.0))
            began, cpu = time.perf_counter(), time.thread_time()
            yield
            self.cpu.append(time.thread_time() - cpu)
            self.late.append(began - due)
            self.took.append(time.perf_counter() - began)
            due = max(due, time.perf_counter() - self._period)

    def told(self, **more: Any) -> str:
        columns = {"late_ms": self.late, "took_ms": self.took, "cpu_ms": self.cpu}
        return json.dumps({name: 1e3 * float(np.median(values)) for name, values in columns.items()} | more)


def publish(run: str, seconds: float) -> None:
    """The ROS 2 program: host of the simulated arm, and publisher of its joint states."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import float64, int32, sequence, uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    stamp = make_idl_struct("Time_", "builtin_interfaces::msg::dds_::Time_", {"sec": int32, "nanosec": uint32})
    header = make_idl_struct("Header_", "std_msgs::msg::dds_::Header_", {"stamp": stamp, "frame_id": str})
    columns = dict.fromkeys(("position", "velocity", "effort"), sequence[float64])
    fields = {"header": header, "name": sequence[str], **columns}
    kind = make_idl_struct("JointState_", "sensor_msgs::msg::dds_::JointState_", fields)
    quality = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
    participant = DomainParticipant(int(DOMAIN))
    writer = DataWriter(participant, Topic(participant, f"rt{TOPIC}", kind, qos=quality), qos=quality)
    hosted, began = HostedArm(run), time.time_ns()
    goals, names, passes = hosted.goals(1 / HOST_HZ), list(hosted.arm.joint_names), Passes(HOST_HZ, seconds)
    for _ in passes:
        sample = hosted.cycle(next(goals))
        now = began + round(1e9 * sample.t)  # of the readings, however late this program is
        values = [each.tolist() for each in (sample.position, sample.velocity, sample.motor_torque)]
        writer.write(kind(header(stamp(now // 10**9, now % 10**9), ""), names, *values))
    print(passes.told(writes=len(passes.took)))


def teleoperate(port: str, seconds: float) -> None:
    """The LeRobot-like program: positions by one group read and goals by one group write a pass, as LeRobot does."""
    import scservo_sdk as sdk

    line, packet = sdk.PortHandler(port), sdk.PacketHandler(0)
    line.setBaudRate(1_000_000)
    line.setPacketTimeout = lambda size: line.setPacketTimeoutMillis(PATIENCE_MS)
    ids = list(range(1, len(SERVOS) + 1))
    reads = sdk.GroupSyncRead(line, packet, SERVO.position.address, SERVO.position.size)
    writes = sdk.GroupSyncWrite(line, packet, SERVO.target.address, SERVO.target.size)
    described = gcomp_arm(hosted_arm())
    goals, passes, requests, here = None, Passes(LOOP_HZ, seconds), 0, np.zeros(len(ids))
    for _ in passes:
        reads.clearParam()
        reads.start_address, reads.data_length = SERVO.position.address, SERVO.position.size
        for servo in ids:
            reads.addParam(servo)
        requests += 1
        if reads.txRxPacket() != 0:
            continue
        if goals is None:
            counts = [reads.getData(servo, SERVO.position.address, SERVO.position.size) for servo in ids]
            here = SERVO.position.unit * (np.array(counts) - SERVO.position.centre)
            speeds, random = np.full(len(ids), 0.8), np.random.default_rng(3)
            goals = work_targets(here, described.lower, described.upper, speeds, 1 / LOOP_HZ, random, WorkMotion())
        writes.clearParam()
        for servo, goal in zip(ids, next(goals), strict=True):
            writes.addParam(servo, list(round(goal / SERVO.target.unit + SERVO.target.centre).to_bytes(2, "little")))
        writes.txPacket()
        requests += 1
    print(passes.told(writes=requests))


class ServoArm(ServoBench):
    """The simulated arm at work as servos: their registers are its readings at the time of the request.

    It is simulated beforehand, so that the servos answer at once on a busy machine, too.
    """

    def __init__(self, run: str, seconds: float) -> None:
        super().__init__(list(range(1, len(SERVOS) + 1)), dynamixel=False, before_answer=self._show)
        hosted = HostedArm(run)
        goals = hosted.goals(1 / HOST_HZ)
        samples = [hosted.cycle(next(goals)) for _ in range(int(HOST_HZ * seconds))]
        self._values = np.array([(each.position, each.velocity, each.motor_torque) for each in samples])
        self._began = math.nan

    def _show(self) -> None:
        now = time.monotonic()
        self._began = now if math.isnan(self._began) else self._began
        place = min((now - self._began) * HOST_HZ, len(self._values) - 1.001)
        before, share = int(place), place % 1
        position, velocity, torque = (1 - share) * self._values[before] + share * self._values[before + 1]
        for servo, row in enumerate(zip(position, velocity, torque / TORQUE_CONSTANT, strict=True), 1):
            for register, value in zip((SERVO.position, SERVO.velocity, SERVO.current), row, strict=True):
                self._put(servo, register, value)

    def _put(self, servo: int, register: Any, value: float) -> None:
        count = round(value / register.unit) + register.centre
        sign = 1 << register.sign_bit
        self.put(servo, register.address, (sign | -count if count < 0 else count).to_bytes(register.size, "little"))


def listeners_arm(kind: str, channel: str, folder: Path) -> Path:
    """The arm file of who listens: no drives, the names that the messages have."""
    content = yaml.safe_load(load_arm(ARM).path.read_text())
    joints = content["link"]["joints"]
    for name, row in zip(SERVOS, joints, strict=True):
        lerobot = {"joint": name, "effort": "current", "torque_constant": TORQUE_CONSTANT}
        row["drive"] = {"family": "joint_state", **({"joint": row["name"]} if kind == "ros2" else lerobot)}
    rate = HOST_HZ if kind == "ros2" else LOOP_HZ
    content["link"] = {"bus": {"interface": kind, "channel": channel}, "rate": rate, "joints": joints}
    path = folder / f"{kind}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def armlink(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "from armlink.cli import main; main()", *arguments]


def writers(seconds: float) -> int:
    """Writers in the domain, but for DDS's own, that were there within so many seconds."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.domain import DomainParticipant

    participant = DomainParticipant(int(DOMAIN))
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    time.sleep(seconds)
    return len({each.key for each in reader.take(100)})


def run_of(kind: str, run: str, seconds: float, folder: Path) -> tuple[dict[str, Any], int, Path]:
    """The program's figures, writes that were heard (writers, or requests on the line), and the recording."""
    recording, this, others = folder / f"{kind}-{run}.mcap", [sys.executable, __file__], 0
    if kind == "ros2":
        arm = listeners_arm(kind, TOPIC, folder)
        with subprocess.Popen([*this, "--program", run, "--seconds", str(seconds)], stdout=subprocess.PIPE) as program:
            heard = _record(arm, recording, run, seconds)
            others = writers(seconds)
            told, _ = program.communicate()
            heard.wait() if heard else None
        return json.loads(told), others, recording
    with ServoArm(run, seconds) as servos:
        arm = listeners_arm(kind, f"so101_follower:{servos.port}", folder)
        command = [str(Path(__file__)), "--program", servos.port, "--seconds", str(seconds)]
        tapped = [sys.executable, "-m", "armlink.lerobot", "--currents", *command]
        with subprocess.Popen(
            [sys.executable, *command] if run == "alone" else tapped, stdout=subprocess.PIPE
        ) as program:
            heard = _record(arm, recording, run, seconds)
            told, _ = program.communicate()
            heard.wait() if heard else None
        others = bytes(servos.heard).count(b"\xff\xff\xfe")
    return json.loads(told), others, recording


def _record(arm: Path, recording: Path, run: str, seconds: float) -> "subprocess.Popen[bytes] | None":
    if run == "alone":
        return None
    return subprocess.Popen(
        armlink("record", str(arm), str(recording), "--seconds", str(seconds)), stdout=subprocess.DEVNULL
    )


def diagnosed(kind: str, run: str, recording: Path, folder: Path) -> tuple[bool, str]:
    """Whether the diagnosis says what the arm has, and its words."""
    answer = folder / f"{kind}-{run}.json"
    channel = ["gap", "diagnose", "--sim", str(folder / f"{kind}.yaml"), "--train", str(recording)]
    subprocess.run(armlink(*channel, "--json", str(answer)), check=False, stdout=subprocess.DEVNULL)
    found = json.loads(answer.read_text())
    causes = [
        (each["effect"], joint, name, value["value"])
        for each in found["causes"]
        for joint, values in each["parameters"].items()
        for name, value in values.items()
    ]
    said = f"{found['verdict']}: " + "; ".join(f"{e} {j} {n} {np.round(v, 3)}" for e, j, n, v in causes)
    if run == "sound":
        return not any(effect in ("link.payload", "actuator.gain", "torque.gain") for effect, *_ in causes), said
    if run == "payload":
        masses = [value for effect, _, name, value in causes if effect == "link.payload" and name == "mass"]
        return any(abs(mass - PAYLOAD) < TOLERANCE * PAYLOAD for mass in masses), said
    gains = [value for effect, joint, _, value in causes if effect.endswith(".gain") and joint == JOINT]
    changes = [min(abs(value), abs(abs(value) - 1)) for value in gains]
    return any(abs(each - (CONSTANT - 1)) < TOLERANCE * (CONSTANT - 1) for each in changes), said


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="beside each program")
    parser.add_argument("--only", choices=("ros2", "lerobot"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--program", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.program:
        (publish if given.program in RUNS else teleoperate)(given.program, given.seconds)
        return 0
    os.environ |= {"ROS_DOMAIN_ID": DOMAIN, "CYCLONEDDS_URI": CYCLONEDDS, "PYTHONPATH": str(Path(__file__).parents[2])}
    folder = given.out or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    right, seconds = True, 60 * given.minutes / len(RUNS)
    for kind in (given.only,) if given.only else ("ros2", "lerobot"):
        alone: dict[str, Any] = {}
        for run in RUNS:
            told, heard, recording = run_of(kind, run, seconds, folder)
            alone = alone or told
            later = max(told[each] - alone[each] for each in ("late_ms", "took_ms"))
            others = heard - (1 if kind == "ros2" else told["writes"])
            found, said = (True, "") if run == "alone" else diagnosed(kind, run, recording, folder)
            ok = later <= LATER_MS and others == 0 and found
            right = right and ok
            late, took, cpu = (told[name] for name in ("late_ms", "took_ms", "cpu_ms"))
            print(
                f"{kind} {run}: passes {late:.3f} ms late and {took:.3f} ms long, {cpu:.3f} ms of the CPU (medians), "
                f"{later:+.3f} ms with a listener; {others} writes of others; {said}{'' if ok else ' WRONG'}",
                flush=True,
            )
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
