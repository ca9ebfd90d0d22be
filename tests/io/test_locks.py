"""Two calls never write into one folder: the second is refused with the number of the first."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import yaml

from gsim3d.cli.main import main
from gsim3d.errors import InputError
from gsim3d.evaluate.demo import run_demo
from gsim3d.io.locks import LOCK_FILE, only_one_writer
from gsim3d.io.settings import to_dict
from gsim3d.train.loop import Trainer
from tests.tiny_scenes import write_scenes
from tests.train.test_loop import CONFIG, curve, scenes

HOLD = """\
import sys
from pathlib import Path
from gsim3d.io.locks import only_one_writer
with only_one_writer(Path(sys.argv[1])):
    print(flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path):
    """Another process that holds the lock of the folder "out"."""
    (tmp_path / "out").mkdir()
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path / "out")], **pipes, cwd=Path.cwd()) as process:
        process.stdout.readline()
        yield process
        process.stdin.close()


def test_second_writer_error_names_the_first(tmp_path, other):
    with pytest.raises(InputError, match=rf"process {other.pid} on .* is writing to {tmp_path / 'out'}; wait for it"):
        with only_one_writer(tmp_path / "out"):
            pass
    with only_one_writer(tmp_path):  # another folder
        pass
    other.send_signal(signal.SIGKILL)
    other.wait()
    with only_one_writer(tmp_path / "out"), only_one_writer(tmp_path / "out" / "."):
        assert (tmp_path / "out" / LOCK_FILE).read_text().startswith(f"{os.getpid()} on ")
    assert not (tmp_path / "out" / LOCK_FILE).exists() and not (tmp_path / LOCK_FILE).exists()


def test_lock_covers_threads_and_links(tmp_path, other):
    (tmp_path / "link").symlink_to(tmp_path / "out")
    refused = []

    def try_it():
        try:
            with only_one_writer(tmp_path / "link"):
                pass
        except InputError as error:
            refused.append(str(error))

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    assert len(refused) == 1 and f"process {other.pid} on" in refused[0]


def test_commands_lock_their_folder(tmp_path, other, capsys):
    data, out = write_scenes(tmp_path / "data", 2), tmp_path / "out"
    (tmp_path / "train.yaml").write_text(yaml.safe_dump(to_dict(CONFIG)))
    assert main(["train", str(tmp_path / "train.yaml"), "--data", str(data), "--out", str(out)]) == 2
    config = ["--config", str(tmp_path / "train.yaml")]
    assert main(["ablate", str(data), *config, "--rows", "latent", "--out", str(out), "--quiet"]) == 2
    assert capsys.readouterr().err.count(f"gsim3d: error: process {other.pid} on ") == 2
    with pytest.raises(InputError, match=f"process {other.pid} on "):
        run_demo(out)
    with pytest.raises(InputError, match=f"process {other.pid} on "):
        Trainer(CONFIG, scenes(data), out).run(progress=False)
    assert [path.name for path in out.iterdir()] == [LOCK_FILE]


def test_training_locks_its_run_and_leaves_no_file(tmp_path):
    trainer = Trainer(CONFIG, scenes(write_scenes(tmp_path / "data", 2)), tmp_path / "run")
    step, found = trainer.train_step, []

    def train_step():
        found.append((tmp_path / "run" / LOCK_FILE).read_text().split()[0])
        return step()

    trainer.train_step = train_step
    trainer.run(until=1, progress=False)
    assert found == [str(os.getpid())] and len(curve(tmp_path / "run")) == 1
    assert not (tmp_path / "run" / LOCK_FILE).exists()
