"""The log of a run: cut where training goes on, whatever a killed process or another program left in it."""

import json
import os
import sys
import tracemalloc

import pytest

from gsim3d.errors import InputError
from gsim3d.train.log import LOG, Log


def test_log_cut_drops_steps_to_repeat(tmp_path):
    lines = [json.dumps({"step": step, "loss": 0.5}) for step in range(5)]
    (tmp_path / LOG).write_text("\n".join([*lines[:3], "{", "\x00" * 100, *lines[3:], lines[4][:9]]))
    Log(tmp_path).cut(4)
    assert (tmp_path / LOG).read_text().splitlines() == lines[:4] and os.listdir(tmp_path) == [LOG]


def test_log_cut_reads_endless_line_in_bounded_memory(tmp_path):
    (tmp_path / LOG).write_text('{"step": 1}\n')
    os.truncate(tmp_path / LOG, 2**28)
    tracemalloc.start()
    try:
        Log(tmp_path).cut(4)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
    assert (tmp_path / LOG).read_text() == '{"step": 1}\n'


def test_log_beyond_a_gibibyte_is_refused_and_kept(tmp_path):
    (tmp_path / LOG).write_text('{"step": 1}\n')
    os.truncate(tmp_path / LOG, 2**30 + 1)
    with pytest.raises(InputError, match=f"{LOG}: has 1073741825 bytes"):
        Log(tmp_path).cut(4)
    assert (tmp_path / LOG).stat().st_size == 2**30 + 1 and os.listdir(tmp_path) == [LOG]


def test_log_that_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / LOG)
    with pytest.raises(InputError, match=f"{LOG}: cannot be read: it is not a file"):
        Log(tmp_path).cut(4)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_what_cannot_be_read_is_named(tmp_path):
    (tmp_path / LOG).symlink_to("/proc/self/mem")
    with pytest.raises(InputError, match=f"{LOG}: cannot be cut to step 4: Input/output error"):
        Log(tmp_path).cut(4)
    assert os.listdir(tmp_path) == [LOG]
