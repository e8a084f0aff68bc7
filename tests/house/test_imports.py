"""What importing loads: modules of one package never bring in what only another needs."""

import subprocess
import sys

import pytest

MODULES = """
import importlib, pkgutil, sys
package = importlib.import_module({package!r})
for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
    importlib.import_module(module.name)
print(*sorted({{name.partition(".")[0] for name in sys.modules}}))
"""


def loaded_by(source: str) -> set[str]:
    """Names of the top packages that a fresh interpreter holds after running the source."""
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_gcomp_loads_neither_the_can_stack_nor_mujoco():
    loaded = loaded_by(MODULES.format(package="gcomp"))
    assert "gcomp" in loaded
    assert not loaded & {"can", "canopen", "mujoco", "pydantic", "armlink", "calib", "sim_bus", "sim_gap"}


def test_the_simulated_arm_loads_no_gravity_code_of_ours():
    loaded = loaded_by(MODULES.format(package="sim_bus"))
    assert "sim_bus" in loaded
    assert "gcomp" not in loaded


@pytest.mark.parametrize("package", ["armlink", "calib", "gcomp", "sim_bus", "sim_gap"])
def test_a_package_alone_is_light(package):
    loaded = loaded_by(f"import sys, {package}; print(*{{name.partition('.')[0] for name in sys.modules}})")
    assert not loaded & {"numpy", "scipy", "can", "canopen", "mujoco", "pydantic", "plotly", "pyarrow"}
