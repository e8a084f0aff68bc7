"""Where Linux's own calls are missing, as on macOS: everything loads, and what needs no bus works."""

import subprocess
import sys

import pytest

ELSEWHERE = """
import ctypes, os, resource, select, selectors, signal, socket, sys

def drop(module, *beginnings):
    for name in [name for name in dir(module) if name.startswith(beginnings)]:
        delattr(module, name)

drop(os, "sched_", "SCHED_", "eventfd", "EFD_", "memfd", "MFD_", "pidfd", "posix_fadvise", "posix_fallocate", "splice",
     "getrandom", "GRND_", "setns", "unshare", "CLONE_", "copy_file_range", "listxattr", "getxattr", "setxattr")
drop(socket, "AF_CAN", "PF_CAN", "CAN_", "SOL_CAN", "AF_NETLINK", "AF_PACKET", "AF_VSOCK", "AF_ALG", "SO_PEERCRED",
     "SO_MARK", "SO_PRIORITY", "SO_BINDTODEVICE", "SOCK_CLOEXEC", "SOCK_NONBLOCK", "TCP_USER_TIMEOUT", "MSG_NOSIGNAL")
drop(select, "epoll", "EPOLL")
drop(selectors, "EpollSelector")
drop(signal, "sigwaitinfo", "sigtimedwait", "SIGRTM", "SIGPWR", "SIGSTKFLT", "SIGPOLL", "pidfd")
drop(resource, "prlimit", "RLIMIT_SIGPENDING", "RLIMIT_RTPRIO", "RLIMIT_MSGQUEUE", "RUSAGE_THREAD")
import time
drop(time, "CLOCK_BOOTTIME", "CLOCK_TAI")

import importlib, pkgutil
for package in ("armlink", "calib", "gcomp", "sim_bus", "sim_gap"):
    walked = pkgutil.walk_packages(importlib.import_module(package).__path__, package + ".")
    for module in walked:
        if "migrations" not in module.name:
            importlib.import_module(module.name)

from armlink import cli
import armlink
with armlink.open_link("sarcos", simulated=True) as link:
    link.start()
    link.enable()
for words in (["--help"], ["sweep", "sarcos", "--plan"], ["scan", "sarcos"], ["doctor", "sarcos"], ["drives"]):
    status = cli.run(words)
    assert status == 0, (words, status)
"""


@pytest.mark.long
def test_what_needs_no_bus_needs_no_linux(tmp_path):
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
