"""The command line: text that is safe on a terminal, hints, ranges, paths to write, full disks and closed pipes."""

import errno
import io
import json
import os
import re
import subprocess
import sys

import pytest

from gsim3d.cli import main as command_line
from gsim3d.cli.arguments import Parser, number, whole
from gsim3d.cli.main import COMMANDS, main
from gsim3d.errors import InputError, did_you_mean
from gsim3d.io.files import new_output_path, output_path, shown, with_parents, write_whole
from gsim3d.io.terminal import Terminal, progress
from gsim3d.train.config import TrainConfig
from gsim3d.train.restore import model_config
from tests.tiny_scenes import write_scene

CASES = {
    "ESC": "\x1b[2J", "BEL": "\x07", "C1": "\x9b31m", "DEL": "\x7f", "return": "a\rb", "surrogate": "\udcff",
    "turned": "\u202e",
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_plain_escapes_control_characters(name):
    stream = io.StringIO()
    print(f"scene {CASES[name]}/0000\n\tnext", file=Terminal(stream))
    text = stream.getvalue()
    assert text.endswith("/0000\n\tnext\n") and "\\" in text
    assert all(letter in "\n\t" or (letter.isprintable() and not "\ud800" <= letter <= "\udfff") for letter in text)


def test_terminal_passes_text_and_bars():
    for text in ("Ärger 猫 – ½\n", "\r 50%|█████     |"):
        stream = io.StringIO()
        Terminal(stream).write(text)
        assert stream.getvalue() == text
    ascii_only = io.TextIOWrapper(io.BytesIO(), "ascii")
    Terminal(ascii_only).write("½")
    Terminal(ascii_only).flush()
    assert ascii_only.buffer.getvalue() == b"\\xbd"


HOSTILE = "a\x1b]0;pwned\x07\x1b[2J\udcff.png"


@pytest.mark.parametrize(
    "arguments",
    [
        ["check-data", "{scene}"],
        ["plan", "{scene}", HOSTILE],
        ["plan", HOSTILE],
        ["evaluate", HOSTILE, HOSTILE],
        ["simulate", "{scene}", "{scene}", "--out", HOSTILE, "--edit", HOSTILE],
        ["train", HOSTILE, "--data", HOSTILE, "--out", HOSTILE],
        ["generate", HOSTILE, "--out", HOSTILE],
        ["generate", "elastic", "--objects", HOSTILE, "--out", "{scene}"],
        ["import", HOSTILE, "--config", HOSTILE, "-o", HOSTILE],
        ["doctor", "--stability", HOSTILE],
        ["simulate", "--" + HOSTILE],
        [HOSTILE],
    ],
)
def test_commands_escape_file_names(tmp_path, capsys, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "x"
    scene.mkdir()
    frame = {"file_path": HOSTILE, "camera": "\x1b[31mRED", "transform_matrix": [[1, 0, 0, 0]] * 4, "time": 0.0}
    lens = {"fl_x": 40, "cx": 16, "cy": 16, "w": 32, "h": 32, "near": 0.5, "far": 6}
    (scene / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    assert main([word.format(scene=scene) for word in arguments]) in (1, 2)
    printed = capsys.readouterr()
    text = printed.out + printed.err
    assert text and not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]", text)
    assert "Traceback" not in text


def test_progress_is_hidden_without_terminal(capsys, monkeypatch):
    for terminal, quiet in ((True, False), (True, True), (False, False)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
        assert list(progress(range(2), "scenes", unit="scene", quiet=quiet)) == [0, 1]
        assert ("2/2" in capsys.readouterr().err) == (terminal and not quiet)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["simulat"], "unknown command 'simulat'; .*; did you mean simulate?"),
        (["pareto", "x"], "gsim3d pareto is now gsim3d profile"),
        (["chekdata"], "; did you mean check-data?"),
        (["--versoin"], "; did you mean --version?"),
        (["generate", "elastic", "--engine", "mujco", "--out", "{new}"], "; did you mean mujoco?"),
        (["generate", "elastic", "--out", ""], "out must not be empty"),
        (["check-data", ""], "data must not be empty"),
        (
            ["generate", "elastic", "--trajectories", "9" * 20, "--out", "{new}"],
            "n_trajectories must be",
        ),
        (["generate", "elastic", "--fps", "1e12", "--out", "{new}"], "fps must be at most 10000; got"),
        (["generate", "rigid", "--objects", "none", "--out", "{new}"], "objects and mesh files must have one name"),
        (["plan", "{new}", "elastic-small"], "new is not a folder"),
        (["xyzzy"], "unknown command 'xyzzy'; commands: generate.*, doctor (see"),
        (["--quiet", "train"], "the command comes first: gsim3d train ...; got '--quiet' before it"),
        (["simulate", "a", "b", "--ou", "c"], "unrecognized arguments: --ou; did you mean --out?"),
        (["simulate", "a", "b", "--oout=c"], "unrecognized arguments: --oout; did you mean --out?"),
        (["generate", "elastic", "--trajectory", "3", "--out", "c"], "; did you mean --trajectories?"),
        (["train", "--print"], "unrecognized arguments: --print"),
        (["simulate", "a", "b", "--out", "c", "--device", "cud"], "invalid choice: 'cud' .*; did you mean cuda?"),
        (["weights", "lpip"], "; did you mean lpips?"),
        (["generate", "elastik", "--out", "{new}"], "world 'elastik' .*; did you mean elastic?"),
        (["generate", "elastic", "--preset", "publishd", "--out", "{new}"], "; did you mean published?"),
        (["generate", "elastic", "--set", "uneen", "--out", "{new}"], "; did you mean unseen?"),
        (["generate", "elastic", "--objects", "bal", "--out", "{new}"], "; did you mean ball?"),
        (["plan", "{scene}", "elastic-smal"], "; did you mean elastic-small?"),
        (["simulate", "rigid", "{scene}", "--out", "{new}"], "; did you mean rigid-small?"),
        (["evaluate", "elastic-small", "{scene}", "--metrics", "psn"], "; did you mean psnr?"),
        (["doctor", "--stability", "--only", "rotat"], "; did you mean rotate?"),
        (["train", "{config}", "--print-config"], "weight_decy: unknown setting.*; did you mean weight_decay?"),
        (["plan", "{scene}", "--effects", "{effects}"], "; did you mean history?"),
        (["ablate", "{scene}", "--rows", "explict", "--out", "{new}"], "; did you mean explicit?"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_commands_suggest_near_words(tmp_path, capsys, arguments, message):
    (tmp_path / "config.yaml").write_text("optimizer: {weight_decy: 1}")
    (tmp_path / "effects.yaml").write_text("dynamics: {histroy: 1}")
    paths = {name: tmp_path / f"{name}.yaml" for name in ("config", "effects")} | {"new": tmp_path / "new"}
    if "{scene}" in arguments:
        paths["scene"] = write_scene(tmp_path / "scene", n_steps=3)
    assert main([word.format(**paths) for word in arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and re.search(re.sub(r"([?()])", r"\\\1", message), err), err


def test_errors_are_bounded(tmp_path, capsys):
    (tmp_path / "a.obj").write_text(f"mtllib {'a' * 100_000}\nusemtl b\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert main(["generate", "elastic", "--out", str(tmp_path / "new"), "--mesh", str(tmp_path / "a.obj")]) == 2
    assert len(capsys.readouterr().err) < 2100


def test_did_you_mean_ignores_distant_words():
    assert did_you_mean("xyzzy", ["train", "plan"]) == "" and did_you_mean(None, ["plan"]) == ""
    assert did_you_mean("TRAIN", ["train", "plan"]) == "; did you mean train?"
    assert did_you_mean("a" * 10**6, ["train"]) == ""
    with pytest.raises(InputError, match="preset: must be one of tiny, .* did you mean tiny"):
        model_config(TrainConfig(preset="tinny"))


def test_commands_refuse_abbreviated_options(capsys):
    for name, (module, _) in COMMANDS.items():
        parser = Parser(prog=name)
        command_line.importlib.import_module(module).add_arguments(parser)
        assert not parser.allow_abbrev
        long = [option for option in parser._option_string_actions if len(option) > 4]
        for option in long:
            if option[:-1] not in parser._option_string_actions:
                with pytest.raises(InputError, match=f"unrecognized arguments: {option[:-1]}; did you mean {option}"):
                    parser.parsed([option[:-1], "1"])
    capsys.readouterr()


@pytest.mark.parametrize(
    "command, option, values",
    [
        ("generate elastic --out x", "--size", ["7", "0", "-64", "99999", "64.5"]),
        ("generate elastic --out x", "--frames", ["0", "-1"]),
        ("generate elastic --out x", "--fps", ["0", "-1", "nan", "inf"]),
        ("generate elastic --out x", "--trajectories", ["0"]),
        ("generate elastic --out x", "--seed", ["-1"]),
        ("generate elastic --out x", "--processes", ["0"]),
        ("generate elastic --out x", "--camera-spread", ["-0.1", "3", "nan"]),
        ("generate elastic --out x", "--drop", ["0 1", "nan 1"]),
        ("simulate a b --out x", "--steps", ["0", "-3"]),
        ("simulate a b --out x", "--start", ["-1"]),
        ("simulate a b --out x", "--cameras", ["-1"]),
        ("evaluate a b", "--steps", ["0"]),
        ("evaluate a b", "--given", ["0"]),
        ("train c --data d --out x", "--until", ["0"]),
        ("profile a b --out x", "--minutes", ["0", "nan"]),
        ("ablate a --out x", "--seeds", ["0"]),
        ("ablate a --out x", "--minutes", ["-1", "inf"]),
        ("doctor --stability", "--steps", ["0"]),
    ],
)
def test_commands_check_options_before_reading(tmp_path, monkeypatch, capsys, command, option, values):
    monkeypatch.chdir(tmp_path)
    for value in values:
        assert main([*command.split(), option, *value.split()]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and f"argument {option}: " in err and value.split()[0].strip("-") in err, err
    assert not list(tmp_path.iterdir())


def test_number_ranges():
    assert whole(2, 4)("4") == 4 and number(0, above=True)("1e-3") == 1e-3 and number(0)("0") == 0


def test_output_path_makes_folders_and_refuses_files(tmp_path):
    assert with_parents(new_output_path(tmp_path / "a" / "b" / "c")).parent.is_dir()
    with pytest.raises(InputError, match="--out: .* exists already; name another folder"):
        new_output_path(tmp_path / "a")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="exists already"):
        new_output_path(tmp_path / "dangling")
    (tmp_path / "file").write_text("")
    for check, name in ((new_output_path, "b"), (output_path, "b/c.json")):
        with pytest.raises(InputError, match="file, which is no folder"):
            check(tmp_path / "file" / name)
    with pytest.raises(InputError, match=r"--export: the name must end in .png; got"):
        output_path(tmp_path / "a.jpg", ".png", "--export")


def test_shown_is_short():
    bomb = ["x"]
    for _ in range(60):
        bomb = [bomb] * 9
    assert len(shown(bomb)) < 500 and len(shown("a" * 10**6)) < 100 and len(shown(10**5000)) < 100


def limited(tmp_path, size, *arguments):
    """A command whose files may have ``size`` bytes at most: writing more fails as on a full disk."""
    program = (
        "import resource, sys; from gsim3d.cli.main import main; "
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size})); sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)


def test_full_disk_error_names_the_path(tmp_path, capsys, monkeypatch):
    def full(args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("gsim3d.cli.generate.run", full)
    assert main(["generate", "elastic", "--out", "some/place"]) == 2
    assert capsys.readouterr().err == "gsim3d: error: some/place: No space left on device\n"
    scene = write_scene(tmp_path / "scene", n_steps=3, size=128)
    done = limited(tmp_path, 1000, "check-data", scene, "--out", "sheet.png")
    assert done.returncode == 2 and done.stderr == "gsim3d: error: sheet.png: File too large\n"


def test_full_disk_behind_the_output_is_named():
    command = [sys.executable, "-m", "gsim3d", "train", "--print-config"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode != 0 and "<stdout>: No space left" in done.stderr, done.stderr


@pytest.mark.parametrize("processes", [1, 2])
def test_full_disk_error_of_generate(tmp_path, processes):
    made = ["generate", "elastic", "--size", "16", "--frames", "2", "--trajectories", "2", "--out", "made", "--quiet"]
    done = limited(tmp_path, 50, *made, "--processes", processes)
    assert done.returncode == 2 and done.stderr == "gsim3d: error: made: File too large\n"


def test_write_whole_is_atomic(tmp_path, monkeypatch):
    write_whole(tmp_path / "a.txt", "before \udcff")
    assert (tmp_path / "a.txt").read_text() == "before \\udcff"

    def full(part, path):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left on device: '.*a.txt'"):
        write_whole(tmp_path / "a.txt", "after")
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text().startswith("before")


def test_closed_pipe_is_no_error(tmp_path):
    command = f"{sys.executable} -m gsim3d {{}} | true; echo ${{{{PIPESTATUS[0]}}}}"
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    for words in ("--help", "train --print-config", "generate --help"):
        done = subprocess.run(
            ["bash", "-c", command.format(words)], capture_output=True, text=True, env=environment, check=True
        )
        assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_are_no_error(closed):
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    for words, code in (("--version", 0), ("generate --help", 0), ("no-command", 2)):
        command = f"{sys.executable} -m gsim3d {words} {closed}; echo $?"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=environment, check=True)
        assert done.stdout.endswith(f"{code}\n") and "Traceback" not in done.stderr
