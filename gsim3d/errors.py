"""Typed errors. The command line turns them into one line and exit code 2."""


class InputError(ValueError):
    """A file, folder, option or argument is not what it must be; the message names it and says what to do."""


class HardCaseError(ValueError):
    """Numbers that no op can use (NaN, Inf, out of range); the message names scene, step, row and tensor."""
