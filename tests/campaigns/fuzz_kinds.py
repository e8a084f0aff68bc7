"""What users hand to armlink, by kind: files to begin with, and how commands load them."""

import json
import sqlite3
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet

sys.path.insert(0, str(Path(__file__).parents[1] / "calib"))
sys.path.insert(0, str(Path(__file__).parents[1] / "calib/sweep"))
sys.path.insert(0, str(Path(__file__).parents[1] / "calib/daemon/web"))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink"))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink/recording"))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink/bus"))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink/guard"))

from compromised import content_of
from daemon_bench import DaemonBench
from fake_joints import make_arm
from made_records import arm_file, calibration, gravity
from rosbags.rosbag2 import StoragePlugin
from small_arm import small_arm
from test_data_sets import written
from test_frame_log import Conversation
from test_ros_bag import states, write

from armlink.arm_file import bundled_arms, load_arm
from armlink.bus.frame_log import LOG_SUFFIXES, FrameLog
from armlink.bus.taps import TappedBus
from armlink.drives.canopen.eds_file import bundled_path, read_sheet
from armlink.errors import ArmlinkError, BadInput
from armlink.guard.bus_guard import Policy, PolicyError
from armlink.link.joints.groups import make_groups
from armlink.model_file import compile_model
from armlink.recording.csv_text import load_columns
from armlink.recording.files import load_recordings, save_recording
from armlink.recording.recording import Recording
from armlink.recording.replay import recording_of_log
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.daemon.settings import daemon_section
from calib.dataset import load_data
from calib.observer.decision import DriftFinding
from calib.records.store import RecordStore
from gcomp.arm.load import load_model
from gcomp.errors import BadModel
from sim_bus.truth import Truth
from sim_gap.experiment import load_motion
from sim_gap.fleet import Answers
from sim_gap.model.load import load_compiled

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Seed:
    """Files of an input by their names, and the one that is given to the command; empty for their folder."""

    files: Mapping[str, bytes]
    given: str = ""

    def put(self, folder: Path) -> Path:
        """Write it into an empty folder; the path to give."""
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return folder / self.given if self.given else folder


@dataclass(frozen=True)
class Kind:
    """A kind of input."""

    seeds: Callable[[Path], list[Seed]]
    load: Callable[[Path], object]
    refusals: tuple[type[Exception], ...] = ()
    """Errors that are refusals too, beside those of our own."""


def one(path: Path, name: str = "") -> Seed:
    return Seed({name or path.name: path.read_bytes()}, name or path.name)


def whole(folder: Path) -> Seed:
    return Seed({str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()})


def path_to_give(kept: Path, folder: Path) -> Path:
    """An input of the corpus in a folder of its own: the arm file, the only file, or the folder."""
    whole(kept).put(folder)
    files = [path for path in folder.rglob("*.yaml" if kept.parent.name == "arm" else "*") if path.is_file()]
    return files[0] if len(files) == 1 else folder


def load_whole_arm(path: Path) -> None:
    """As commands do: the file, its sections, the drives' settings, the arm's geometry, and the simulated one."""
    arm = load_arm(path)
    arm.require_link()
    sweep_section(arm)
    daemon_section(arm)
    make_groups(arm)
    gcomp_arm(arm)
    Truth.of(arm)


def arms(_: Path) -> list[Seed]:
    found = []
    for path in bundled_arms().values():
        model = load_arm(path).model_path
        beside = {model.name: model.read_bytes()} if model is not None and model.parent == path.parent else {}
        found.append(Seed({path.name: path.read_bytes(), **beside}, path.name))
    return found


def records(_: Path) -> list[Seed]:
    made = [each.model_dump_json(indent=1).encode() for each in (calibration(), gravity())]
    return [Seed({"record.yaml": content}, "record.yaml") for content in made]


def import_record(path: Path) -> None:
    """As `armlink history --import` does."""
    store = RecordStore(str(path.parent / "records.db"))
    try:
        store.import_yaml(path, arm_file())
    finally:
        store.close()


def recording(suffix: str) -> Callable[[Path], list[Seed]]:
    def seeds(folder: Path) -> list[Seed]:
        t = np.arange(120) * 0.01
        wave = np.sin(t)[:, None] * np.ones(2)
        every = dict.fromkeys(("velocity", "motor_torque", "temperature", "position_command"), wave)
        for name, more in (("some", {}), ("all", every)):
            made = Recording(t=t, position=wave, torque=2 * wave, names=("a", "b"), **more)
            save_recording(made, folder / f"{name}{suffix}")
        return [one(folder / f"{name}{suffix}") for name in ("some", "all")]

    return seeds


def motions(folder: Path) -> list[Seed]:
    arm, rows = load_arm(ROOT / "examples" / "planar3.yaml"), np.arange(40)
    lines = ["t,q_cmd_1,q_cmd_2,q_cmd_3,q_1,q_2,q_3"]
    middle = (gcomp_arm(arm).lower + gcomp_arm(arm).upper) / 2
    lines += [",".join(f"{x:.6f}" for x in (0.01 * k, *(middle + 1e-4 * k), *middle)) for k in rows]
    (folder / "motion.csv").write_text("\n".join(lines) + "\n")
    return [one(folder / "motion.csv")]


def load_a_motion(path: Path) -> None:
    load_columns(path, ["q_1", "q_2", "q_3"])
    load_motion(path, load_arm(ROOT / "examples" / "planar3.yaml"))


def bags(folder: Path) -> list[Seed]:
    kind, found = "sensor_msgs/msg/JointState", []
    arm = [(k * 10**7, states("ba", [0.1 * k, 1.0], [5.0, -k])) for k in range(1, 30)]
    motor = [(k * 10**7 + 10**6, states("ba", [], [1.0, k])) for k in range(1, 30)]

    def dynamic(types):
        value = types.types["control_msgs/msg/InterfaceValue"]
        rows = [value(interface_names=["effort", "position"], values=np.array([7.0, 0.5])) for _ in "xy"]
        return {"joint_names": ["x", "y"], "interface_values": rows}

    def controller(types):
        still = types.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        point = types.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        made = [point(np.ones(2), np.zeros(2), np.zeros(0), np.zeros(2), still) for _ in range(2)]
        return {"joint_names": ["x", "y"], "reference": made[0], "feedback": made[1]}

    others = {"DynamicJointState": dynamic, "JointTrajectoryControllerState": controller}
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        write(folder / f"a{storage.name}", [("/joint_states", kind, arm), ("/motor_states", kind, motor)], storage)
        found.append(folder / f"a{storage.name}")
        for name, fields in others.items():
            messages = [(k * 10**7, fields) for k in range(1, 10)]
            found.append(folder / f"{name}{storage.name}")
            write(found[-1], [("/state", f"control_msgs/msg/{name}", messages)], storage)
    alone = [next(each.glob("*.mcap")) for each in found if each.name.endswith("MCAP")]
    return [whole(each) for each in found] + [one(each) for each in alone]


def lerobot(folder: Path) -> list[Seed]:
    names = ["shoulder.pos", "elbow.pos"]
    features = {key: {"dtype": "float32", "names": names} for key in ("observation.state", "action")}
    rows = {"timestamp": list(np.arange(20) / 30)} | {key: [[0.1 * k, 0.2] for k in range(20)] for key in features}
    (folder / "meta").mkdir()
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "features": features}))
    for episode in range(2):
        table = pa.table({"episode_index": [episode] * 20, **rows})
        pa_parquet.write_table(table, folder / "data" / "chunk-000" / f"file-{episode:03}.parquet")
    return [whole(folder)]


def frame_logs(folder: Path) -> list[Seed]:
    for suffix in LOG_SUFFIXES:
        with FrameLog(folder / f"run{suffix}") as log:
            bus = TappedBus(Conversation(60), log.write)
            while bus.take(0.0):
                pass
    return [one(folder / f"run{suffix}") for suffix in LOG_SUFFIXES]


def models(_: Path) -> list[Seed]:
    found = [one(path) for path in sorted((ROOT / "tests" / "models").iterdir())]
    return [*found, one(ROOT / "sim_bus" / "arms" / "openarm.xml")]


def load_each_way(path: Path) -> None:
    """As `armlink new`, the collision checks and the diagnosis read it; refused if none of them can."""
    refused: list[Exception] = []
    loads = (load_model, compile_model, load_compiled)
    for load in loads:
        try:
            load(path)
        except (BadInput, BadModel) as error:
            refused.append(error)
            if "\n" in str(error) or len(refused) == len(loads):
                raise


def data_sheets(_: Path) -> list[Seed]:
    return [one(Path(bundled_path()))]


def load_sheet(path: Path) -> None:
    read_sheet(path, load_arm("sarcos").require_link().joints[0])


def data_sets(folder: Path) -> list[Seed]:
    return [whole(written(folder / "sweep"))]


def load_data_set(path: Path) -> None:
    data = load_data(path)
    for name in ("servo", "position", "torque"):
        data.array(name)


def stores(folder: Path) -> list[Seed]:
    store = RecordStore(str(folder / "records.db"))
    for record in (calibration(), gravity(), calibration(1.03)):
        store.put(record, arm_file(), by="fuzz", reason="sweep")
    store.close()
    with sqlite3.connect(folder / "records.db") as db:
        db.execute("PRAGMA journal_mode=DELETE")
    return [one(folder / "records.db")]


def read_store(path: Path) -> None:
    store, arm = RecordStore(str(path)), arm_file()
    try:
        store.history(arm)
        store.activations(arm)
        store.writes(arm)
        store.unfinished_write(arm)
        for record in (calibration(), gravity()):
            store.current(type(record), arm)
    finally:
        store.close()


def journals(folder: Path) -> list[Seed]:
    """The state of a daemon that was killed, with a proposal that was decided and one that was not."""
    bench = DaemonBench(folder, small_arm())
    bench.run(3.0)
    journal, when = bench.service.journal, bench.wall()
    finding = DriftFinding(2, "drift", 1.02, 0.1, np.diag([1e-6, 1e-4]), 40, 0.99)
    for joint in ("elbow", "elbow", "base"):
        journal.add_proposal(when, joint, "ab" * 4, "cd" * 4, finding)
    journal.decide(3, when, "rejected", "ann")
    for _ in range(3):
        bench.service.save(history=True)
    bench.kill()
    bench.store.close()
    for name in ("state/journal.db", "records.db"):
        with sqlite3.connect(folder / name) as db:
            db.execute("PRAGMA journal_mode=DELETE")
    kept = {name: (folder / name).read_bytes() for name in ("state/journal.db", "records.db")}
    return [Seed(kept)]


def start_daemon(folder: Path) -> None:
    """On such a state: it observes or says why not, and some seconds later its API has an answer to everything."""
    try:
        bench = DaemonBench(folder, small_arm(), records=False)
    except ArmlinkError:
        return
    bench.run(4.0)
    view = bench.view
    reads = (view.status, view.events, view.proposals, view.estimates, lambda: list(view.history_pages(None)))
    for read in reads:
        with suppress(sqlite3.Error):  # 503 of the API, once: a row that is damaged and still a row
            read()
    bench.run(4.0)
    for read in reads:
        read()
    bench.kill()
    bench.store.close()


def policies(_: Path) -> list[Seed]:
    return [Seed({"policy.json": json.dumps(content_of(2)).encode()}, "policy.json")]


def load_policy(path: Path) -> None:
    """As the guard does."""
    with path.open(encoding="utf-8") as file:
        Policy(json.load(file))


def answers(_: Path) -> list[Seed]:
    value, which = (
        {"value": 0.5, "unit": "N·m"},
        {"effect": "friction.coulomb", "joint": "elbow", "parameter": "torque"},
    )
    cause = {"effect": "friction.coulomb", "joints": ["elbow"], "shrink": 0.5, "confidence": 0.9, "confounded_with": []}
    answer = {"verdict": "explained", "causes": [{**cause, "parameters": {"elbow": {"torque": value}}}]}
    answer |= {"minor": answer["causes"], "watched": [{**which, **value, "ci95": [0.4, 0.6]}]}
    lines = [{"case": f"a/2026-11-{day}", "answer": answer} for day in range(10, 26)]
    return [Seed({"answers.jsonl": "".join(json.dumps(line) + "\n" for line in lines).encode()}, "answers.jsonl")]


def read_answers(path: Path) -> None:
    from sim_gap.fleet import table
    from sim_gap.trends import fleet_trends

    found = Answers(path).found
    table(found)
    fleet_trends(found)


KINDS = {
    "arm": Kind(arms, load_whole_arm),
    "record": Kind(records, import_record),
    **{suffix[1:].removeprefix("csv."): Kind(recording(suffix), load_recordings) for suffix in (".csv", ".csv.gz")},
    **{suffix[1:]: Kind(recording(suffix), load_recordings) for suffix in (".parquet", ".mcap")},
    "bag": Kind(bags, load_recordings),
    "lerobot": Kind(lerobot, load_recordings),
    "frames": Kind(frame_logs, lambda path: recording_of_log(make_arm(2), path)),
    "model": Kind(models, load_each_way, (BadModel,)),
    "sheet": Kind(data_sheets, load_sheet),
    "sweep": Kind(data_sets, load_data_set),
    "motion": Kind(motions, load_a_motion),
    "store": Kind(stores, read_store),
    "journal": Kind(journals, start_daemon),
    "policy": Kind(policies, load_policy, (ValueError, RecursionError, PolicyError)),
    "answers": Kind(answers, read_answers),
}
