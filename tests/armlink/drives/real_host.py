"""A host of one drive in real time on a port, without the link: what `set_up` asks by, and cycles at 50 Hz or so."""

import math
import time


class Host:
    """The drives of a family on a port."""

    def __init__(self, port, drives):
        self.port, self.drives, self.latest = port, drives, {}

    def __call__(self, frame, answer, timeout=0.1, tries=3):
        for _ in range(tries):
            self.port.send(*frame)
            end = time.monotonic() + timeout
            while (left := end - time.monotonic()) > 0:
                came = self.port.receive(left)
                if came is not None and (found := answer(*came)) is not None:
                    return found
                if came is not None:
                    self.take(*came)
        return None

    def send(self, can_id, data):
        self.port.send(can_id, data)

    def wait(self, done, timeout):
        end = time.monotonic() + max(timeout, 5.0)  # a busy machine
        while not done() and time.monotonic() < end:
            self.listen(0.05)
        return done()

    def now(self):
        return time.monotonic()

    def take(self, can_id, data):
        routes = self.drives.routes()
        if can_id in routes or -1 in routes:
            reading = self.drives.take(can_id, data, self.now())
            if reading is not None and math.isfinite(reading.position):
                self.latest[reading.joint] = reading.position

    def listen(self, seconds):
        while (came := self.port.receive(seconds)) is not None:
            self.take(*came)
            seconds = 0.0

    def until(self, condition, order, seconds=30.0):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            for frame in self.drives.frames([order()], self.now()):
                self.port.send(*frame)
            self.listen(0.02)
        return condition()
