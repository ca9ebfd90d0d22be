"""A function of the tests in two processes that know each other."""

import os
import socket
import subprocess
import sys


def run_in_two_processes(function, *arguments) -> None:
    """``function`` of (rank, *arguments as text), found by its name in its module, in two processes."""
    name = function.__name__
    script = f"import sys; from {function.__module__} import {name}; {name}(int(sys.argv[1]), *sys.argv[2:])"
    environment = {
        **os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1", "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()),
    }  # fmt: skip
    command = [sys.executable, "-c", script]
    running = [
        subprocess.Popen([*command, str(rank), *map(str, arguments)], env={**environment, "RANK": str(rank)})
        for rank in range(2)
    ]
    assert [process.wait(timeout=300) for process in running] == [0, 0]


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]
