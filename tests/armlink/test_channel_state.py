"""What the bus process says of its state arrives, however far behind the service is; of samples the newest do."""

import socket

from armlink.channel import Channel


def test_no_state_is_lost_behind_a_reader_that_is_busy():
    ours, theirs = socket.socketpair()
    sender, reader = Channel(theirs, most=20), Channel(ours)
    for number in range(300):
        if number % 100 == 50:
            sender.put(("state", number))
        sender.put(("sample", number, bytes(20_000)), sample=True)
        sender.flush()
    received = []
    while not sender.flush():
        received += reader.receive()
    received += reader.receive()
    assert [message[1] for message in received if message[0] == "state"] == [50, 150, 250]
    samples = [message[1] for message in received if message[0] == "sample"]
    assert samples == sorted(samples)
    assert samples[-20:] == list(range(280, 300))
    assert sender.dropped == 300 - len(samples) > 0
    places = [message[1] for message in received]
    assert places == sorted(places)
