"""External torque in the daemon: with what was learned it is told and shown; without, why not."""

from pathlib import Path

import numpy as np
import pytest
from fast_daemon import FastDaemon, settings
from served_page import served

from armlink.loop.messages import Batch
from armlink.recording.recording import Recording
from calib.arm.kinematics import StatedModel, gcomp_arm
from calib.daemon.view import ContactItem
from calib.external.arm_model import ArmRecords, listener_of
from calib.external.listening import Learned, WrenchFrame, load_learned, save_learned

PUSH = 6.0
"""Of joint 2 [N·m]."""


def records_of(daemon: FastDaemon) -> ArmRecords:
    feed = daemon.service.records.feed
    assert feed is not None
    return ArmRecords(StatedModel(gcomp_arm(daemon.arm), None, None, None, daemon.arm), feed.calibration, feed.gravity)


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> FastDaemon:
    """A daemon whose arm worked for two minutes, from which `external.npz` was learned; it has not read it yet."""
    daemon = FastDaemon(tmp_path_factory.mktemp("taught"), 1, settings("observe"))
    batches: list[Batch] = []
    take = daemon.service.take
    daemon.service.take = lambda message: (batches.append(message), take(message))  # type: ignore[method-assign]
    daemon.run(120.0)
    daemon.service.take = take  # type: ignore[method-assign]
    t, q, torque = (
        np.concatenate([batch.t if name == "t" else batch.channels[name] for batch in batches])
        for name in ("t", "position", "torque")
    )
    work = Recording(t=t, names=daemon.arm.joint_names, position=q, torque=torque)
    records = records_of(daemon)
    listener = listener_of(records, [work], [])
    frame = WrenchFrame(daemon.fast.n - 1, np.array([0.0, 0.0, 0.1]))
    save_learned(daemon.service.external.path, Learned(listener, frame, 1.0))
    return daemon


def test_without_a_learned_file_the_answer_says_why(tmp_path):
    daemon = FastDaemon(tmp_path, 1, settings("observe"), records=False)
    assert "records" in daemon.view.external().reason
    daemon = FastDaemon(tmp_path / "with", 1, settings("observe"))
    daemon.run(10)
    assert "--learned" in daemon.view.external().reason
    assert daemon.view.external().torque == ()
    assert daemon.view.joints()[1].external_torque is None


def test_a_push_is_told_with_its_bound_and_as_an_event(taught):
    taught.service.reload(taught.arm, taught.settings)
    taught.run(30)
    quiet = taught.view.external()
    assert quiet.reason == ""
    assert quiet.baseline_s == pytest.approx(120, abs=10)
    assert (np.abs(quiet.torque) < np.multiply(quiet.bound, 2.0)).all()
    taught.fast.push = lambda q: np.where(np.arange(q.shape[1]) == 1, -PUSH, 0.0) + 0.0 * q
    taught.run(3)
    pushed = taught.view.external()
    assert abs(pushed.torque[1] - PUSH) < 2.0 * pushed.bound[1]
    assert "joint_2" in pushed.events[-1].joints
    shown = taught.view.joints()[1]
    assert (shown.external_torque, shown.external_bound) == (pushed.torque[1], pushed.bound[1])
    assert pushed.wrench is not None
    taught.fast.push = None
    logged = [each for each in taught.view.events() if each.kind == "contact" and "least_force" in each.evidence]
    assert len(logged) == len({each.evidence["kind"] for each in logged})  # of each kind one a minute
    assert f"{logged[-1].evidence['kind']} " in logged[-1].text
    assert sum(pushed.counts.values()) == len(pushed.events)
    assert {each.evidence["kind"] for each in logged} == {kind for kind, count in pushed.counts.items() if count}


def test_a_contact_is_streamed_at_once_and_counted(taught, tmp_path):
    taught.service.reload(taught.arm, taught.settings)
    taught.run(30)
    client = taught.service.hub.subscribe()
    before = dict(taught.view.external().counts)
    taught.fast.push = lambda q: np.where(np.arange(q.shape[1]) == 1, -PUSH, 0.0) + 0.0 * q
    taught.run(3)
    taught.fast.push = None
    told = [item.contact for item in client._queue if isinstance(item, ContactItem)]
    client.close()
    answer = taught.view.external()
    assert told
    assert tuple(told) == answer.events[-len(told) :]
    assert sum(answer.counts.values()) - sum(before.values()) == len(told)
    snapshot = taught.view.snapshot()
    assert snapshot.wrench == answer.wrench
    assert snapshot.load == answer.load
    with served(lambda: taught.view, tmp_path / "api.sock") as server:
        text = server.client().get("/metrics").text
    for kind, count in answer.counts.items():
        assert f'armlink_contacts_total{{kind="{kind}"}} {float(count)}' in text
    assert 'armlink_joint_external_torque_newton_metres{joint="joint_2"}' in text
    assert 'armlink_joint_external_bound_newton_metres{joint="joint_2"}' in text


def test_the_route_and_the_stream_have_it(taught, tmp_path):
    taught.service.reload(taught.arm, taught.settings)
    taught.run(10)
    with served(lambda: taught.view, tmp_path / "api.sock") as server:
        answer = server.client().get("/api/external").json()
        assert answer["reason"] == ""
        assert len(answer["torque"]) == len(answer["bound"]) == taught.fast.n
        assert server.client().get("/api/joints").json()[1]["external_bound"] == answer["bound"][1]
        assert server.tcp(None).get("/api/external").status_code == 401


def test_what_was_learned_with_other_records_is_not_used(taught, tmp_path):
    other = FastDaemon(tmp_path, 2, settings("observe"))
    other.run(1)
    with pytest.raises(Exception, match="other records"):
        load_learned(taught.service.external.path, records_of(other))
    Path(tmp_path / "bad.npz").write_bytes(b"none")
    with pytest.raises(Exception, match="is not a file that --learned has written"):
        load_learned(tmp_path / "bad.npz", records_of(other))
