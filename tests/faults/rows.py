"""The fault table: a row says what the tests of this folder see. `python rows.py` prints it for docs/faults.md."""

from dataclasses import dataclass
from typing import Any

QUICK_STOP = "quick stop, holding"


@dataclass(frozen=True)
class Row:
    """One fault."""

    key: str
    what: str
    inject: str
    """As `armlink sim --fault` takes it; how else it is brought about, in words."""
    detected: str
    cycles: int | None
    """Cycles until the one that raises, itself included; None where no cycle of the host's sees it."""
    joints: str
    reads: str
    """What the user reads, `…` standing for what differs from run to run."""
    vcan: str = ""
    """Empty: seen on real SocketCAN too. Else why not."""


ARM: dict[str, Any] = {
    "name": "triple",
    "kinematics": {
        "gravity": [0.0, 0.0, -9.81],
        "joints": [
            {"name": f"joint_{i}", "a": 0.2, "alpha": 1.5707963 if i == 1 else 0.0, "lower": -2.0, "upper": 2.0}
            for i in (1, 2, 3)
        ],
    },
    "link": {
        "bus": {"interface": "socketcan", "channel": "vcan0", "bitrate": 1000000},
        "rate": 250,
        "joints": [
            {"name": f"joint_{i}", "node": 10 + i, "rated_torque": 40.0, "max_torque": 30.0, "max_velocity": 2.0}
            for i in (1, 2, 3)
        ],
    },
    "sim": {
        "links": [{"mass": 1.0, "com": [0.1, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]}] * 3,
        "sensors": {"noise": [0.01] * 3},
        "effects": [{"effect": "friction.coulomb", "joint": "joint_1", "torque": 3.0}],
    },
}
"""Joint 1 turns about the vertical, under a bias torque that its friction holds; the others hold their position."""

BUS = "bus …: "
ROWS = (
    Row(
        "node silent",
        "a node falls silent",
        "node.silent:joint_2",
        "no reading",
        26,
        QUICK_STOP,
        "joint_2: no reading for … ms, limit … ms",
    ),
    Row(
        "node reboot",
        "a node restarts",
        "node.reboot:joint_2",
        "boot-up message",
        1,
        f"the brake of this joint closes; the other joints: {QUICK_STOP}",
        "joint_2: its drive has restarted (boot-up message): calibration and mode are lost; find out why, then "
        "start again",
    ),
    Row(
        "bus-off",
        "the host's CAN controller goes bus-off, and restarts",
        "bus.off::0.5",
        "error frame",
        1,
        QUICK_STOP,
        BUS + "bus-off: check wiring, termination and bit rate",
    ),
    Row(
        "link down",
        "the interface goes down, and up again",
        "link.down::0.5",
        "no frame can be sent",
        1,
        QUICK_STOP,
        BUS + "cannot send: Network is down",
    ),
    Row(
        "nobody acknowledges",
        "no node acknowledges frames (ENOBUFS)",
        "bus.full::0.5",
        "the transmit queue stays full (the sending cycle waits 50 ms)",
        1,
        QUICK_STOP,
        BUS + "transmit queue stays full: does any node acknowledge?",
        vcan="vcan acknowledges everything; the socket's own ENOBUFS is in tests/armlink",
    ),
    Row(
        "slow reader",
        "the host reads too slowly",
        "reader.slow::2",
        "frames lost by the receive queue",
        1,
        QUICK_STOP,
        "… frames were lost because this host reads too slowly: stop other programs on this host, or give "
        "the job less to do in each cycle",
        vcan="the kernel's own count is in tests/armlink",
    ),
    Row(
        "babbling node",
        "a node babbles",
        "node.babbling:joint_2:20000",
        "twice as many frames per cycle as these joints may send, in ten cycles",
        11,
        QUICK_STOP,
        "the bus carries more frames than these joints send, most of them 001h: a node babbles, disconnect this node",
    ),
    Row(
        "corrupted frames",
        "a node's frames are destroyed on the wire",
        "frame.corrupt:joint_2",
        "error frames, no reading",
        26,
        QUICK_STOP,
        "joint_2: no reading for … ms, limit … ms",
    ),
    Row(
        "short frames",
        "a node's frames are too short",
        "frame.short:joint_2",
        "wrong lengths counted, no reading",
        26,
        QUICK_STOP,
        "joint_2: no reading for … ms, limit … ms",
    ),
    Row(
        "duplicated id",
        "a second node has the same id",
        "node.duplicate:joint_2",
        "two readings of the joint per cycle, in three consecutive cycles, and more readings than SYNCs",
        4,
        QUICK_STOP,
        "joint_2: two readings come in every cycle, so a second node has the same id: give every node its own id",
    ),
    Row(
        "EMCY storm",
        "a node sends emergencies without end",
        "emcy.storm:joint_2:1000",
        "emergency",
        1,
        QUICK_STOP,
        "joint_2: emergency 7305h, incremental sensor (error register 21h)",
    ),
    Row(
        "SDO abort",
        "a node refuses an SDO request while the arm is started",
        "sdo.abort:joint_2",
        "abort code",
        None,
        "not powered",
        "joint_2 (node 12): …: read refused: Code 0x08000022…",
    ),
    Row(
        "SDO time-out",
        "a node answers no SDO request while the arm is started",
        "sdo.timeout:joint_2",
        "time-out",
        None,
        "not powered",
        "no answer from joint_2 (node 12) on …: check power and wiring, and the ids in the arm file",
    ),
    Row(
        "mode refused",
        "a controller refuses a mode",
        "mode.refused:joint_2:10",
        "mode display 6061h",
        26,
        QUICK_STOP,
        "joint_2: refuses mode 10 (cyclic synchronous torque): its mode display 6061h is 0; read its error "
        "code 603Fh and "
        "its supported modes 6502h",
    ),
    Row(
        "clock jump",
        "time jumps: the host slept for a second",
        "clock.jump::1",
        "emergency of the nodes",
        1,
        QUICK_STOP,
        "joint_1: emergency 8250h, RPDO deadline missed (no command from the host) (error register 11h)",
        vcan="there it is the host stopped, below",
    ),
    Row(
        "wall clock",
        "the host's wall clock is set back by an hour",
        "set the wall clock",
        "not a fault: the link uses the monotonic clock",
        None,
        "continue",
        "nothing",
        vcan="it would set the clock of the machine that runs the tests",
    ),
    Row(
        "host stopped",
        "the host's process stops (SIGSTOP) while a joint is pressed on its stop, and continues",
        "kill -STOP, kill -CONT",
        "RPDO deadline on the device",
        1,
        QUICK_STOP,
        "joint_1: emergency 8250h, RPDO deadline missed (no command from the host) (error register 11h)",
    ),
    Row(
        "host killed",
        "the host's process is killed (SIGKILL) while a joint is pressed on its stop",
        "kill -KILL",
        "RPDO deadline on the device",
        None,
        QUICK_STOP,
        "nothing, since the host's process is dead; `armlink monitor` shows quick stop",
    ),
)


def table() -> str:
    """The table as docs/faults.md has it."""
    lines = [
        "| fault | injected by | detected by | detected within | reaction of the joints | the user reads |",
        "|---|---|---|---|---|---|",
    ]
    for row in ROWS:
        within = "–" if row.cycles is None else "1 cycle" if row.cycles == 1 else f"{row.cycles} cycles"
        inject = f"`{row.inject}`" if ":" in row.inject or row.inject.startswith("kill") else row.inject
        lines.append(f"| {row.what} | {inject} | {row.detected} | {within} | {row.joints} | {row.reads} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
