"""External torque and wrench as a bag, read back by rosbags' own types and by mcap's ROS 2 decoder."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from armlink.recording.wrench_bag import save_wrench_bag


@pytest.mark.parametrize("frame", ["base", "a", ""])
def test_a_bag_has_torques_bounds_and_wrenches(tmp_path, frame):
    t, path = np.array([0.0, 0.04, 1.28]), tmp_path / "out.mcap"
    torque, wrench = np.arange(6.0).reshape(3, 2), np.arange(18.0).reshape(3, 6)
    wrench[1, 4] = np.nan
    save_wrench_bag(path, t, ("j1", "j2"), torque, torque / 10, frame, wrench)
    found = {}
    with path.open("rb") as stream:
        for _, channel, message, said in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, said))
    assert [time for time, _ in found["/external_wrench"]] == [0, 40_000_000, 1_280_000_000]
    for row, (_, said) in enumerate(found["/external_wrench"]):
        force, moment = said.wrench.force, said.wrench.torque
        told = [force.x, force.y, force.z, moment.x, moment.y, moment.z]
        assert told == pytest.approx(wrench[row].tolist(), nan_ok=True)
        assert said.header.frame_id == frame
    assert [list(said.effort) for _, said in found["/external_torque"]] == torque.tolist()
    assert list(found["/external_torque_std"][2][1].effort) == pytest.approx([0.4, 0.5])
