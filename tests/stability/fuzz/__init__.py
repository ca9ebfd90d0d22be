"""Fuzzing: seeded invalid inputs, to every op, public function, command and reader.

    python -m tests.stability.fuzz pool_max ply --count 1000000     many more than the tests take
    python -m tests.stability.fuzz --replay FAILURE                 a failing input again, in this process
    python -m tests.stability.fuzz readers --count 50000            every reader
    tools/fuzz.sh                                                   the same in rounds, 100,000 inputs of each
    python -m tests.stability.fuzz --list

A call must end with finite results and finite gradients, or with an error that names what is wrong; no crash, no hang,
no memory beyond a limit, no silent NaN. Inputs run in a child process (engine.py), so that a crash is found and named.
"""
