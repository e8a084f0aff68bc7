"""What fuzzing found or distilled (tests/campaigns/fuzz_corpus.py): loaded, refused in one line, or answered."""

import logging
import random
import signal
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))
sys.path.insert(0, str(Path(__file__).parents[1] / "campaigns"))

from bench import Bench
from fuzz_api import Tracebacks, begin, exchange, statuses
from fuzz_files import judged, too_slow
from fuzz_kinds import KINDS, path_to_give
from fuzzing import command_too_much, take_in
from served_page import served

from calib.daemon.rate_limit import RateLimit
from calib.daemon.web import connection

CORPUS = Path(__file__).parent / "corpus"
FILES = [folder for kind in KINDS for folder in sorted(CORPUS.glob(f"{kind}/*"))]
FRAMES = sorted((CORPUS / "frames-of-drives").iterdir())


@pytest.mark.parametrize("folder", FILES, ids=lambda folder: f"{folder.parent.name}-{folder.name}")
def test_a_file_loads_or_is_refused_in_one_line(folder, tmp_path):
    (tmp_path / "input").mkdir()
    given = path_to_give(folder, tmp_path / "input")
    before = signal.signal(signal.SIGPROF, too_slow)
    try:
        assert judged(KINDS[folder.parent.name], given) == ""
    finally:
        signal.signal(signal.SIGPROF, before)


@pytest.mark.parametrize("path", FRAMES, ids=lambda path: path.stem)
def test_frames_of_any_content_raise_nothing_and_no_order_leaves_beyond_a_limit(path):
    bench = Bench(path.stem)
    bench.set_up()
    bench.walk()
    for line in path.read_text().splitlines():
        can_id, _, data = line.partition("#")
        take_in(bench, int(can_id, 16), bytes.fromhex(data))
        command_too_much(bench)


def test_every_connection_is_answered_by_http_without_5xx(tmp_path, monkeypatch):
    monkeypatch.setattr(RateLimit, "take", lambda *_: 0.0)
    monkeypatch.setattr(connection, "PATIENCE_SECONDS", 0.5)
    monkeypatch.setattr(logging.getLogger(), "handlers", [told := Tracebacks()])
    answered = 0
    with served(lambda: begin(tmp_path), tmp_path / "api.sock") as server:
        for path in sorted((CORPUS / "api").iterdir()):
            for tcp in (False, True):
                sent = path.read_bytes()
                answered += len(statuses(sent, exchange(server, sent, tcp, random.Random(0)), tcp))
        with server.client() as sound:
            assert sound.get("/api/status").status_code == 200
    assert answered > 50
    assert told.seen == []
