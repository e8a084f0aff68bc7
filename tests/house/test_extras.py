"""Without any extra: every command loads, and arms on other buses than udp_multicast can be driven."""

import subprocess
import sys

WITHOUT = """
import sys
from importlib.abc import MetaPathFinder
from importlib.metadata import entry_points

EXTRAS = {"cryptography", "distributed", "fastapi", "foxglove", "msgpack", "prometheus_client", "psycopg", "rerun"}
EXTRAS |= {"uvicorn"}

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
for group in ("armlink.commands", "armlink.api", "armlink.drives", "armlink.sections"):
    for point in entry_points(group=group):
        point.load()
from armlink.loop.open import open_arm
from armlink.loop.process import DriveLoop
from calib.api import open_link
with open_link("sarcos", simulated=True) as link:
    link.start()
    link.enable()
"""


def test_the_core_needs_no_extra():
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
