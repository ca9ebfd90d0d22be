"""What a pickle would make, looked at before anything of it is made."""

import pickletools

MAX_OPS = 2 * 10**6  # of a pickle; the index of a model with a hundred thousand tensors has fewer
MAX_PARTS, MAX_DEPTH = 10**5, 100  # of a tuple: a key of a table is hashed with all its parts

_MARK = (0, 0)
_SHARED = ("MEMOIZE", "DUP")


def check_pickle(data: bytes) -> None:
    """Raises ValueError where reading ``data`` would take memory or time without end.

    That is: an index of its memo far beyond its length, too many instructions, or tuples that hold each other many
    times, which are hashed as often where they are keys.
    """
    stack, memo = [], {}  # (parts, depth) of each value
    for number, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        if number > MAX_OPS:
            raise ValueError(f"it has more than {MAX_OPS} instructions")
        if "GET" in name:
            stack.append(memo[int(argument)])
            continue
        if "PUT" in name:
            if int(argument) > len(data):
                raise ValueError("an index of its memo is out of range")  # would allocate that many slots
            memo[int(argument)] = stack[-1]
            continue
        parts = _popped(stack, opcode.stack_before)
        if name == "MEMOIZE":
            memo[len(memo)] = parts[0]
        if name.startswith("TUPLE"):
            made = 1 + sum(size for size, _ in parts), 1 + max((depth for _, depth in parts), default=0)
            if made[0] > MAX_PARTS or made[1] > MAX_DEPTH:
                raise ValueError(f"a tuple of more than {MAX_PARTS} parts or {MAX_DEPTH} levels")
        elif name in _SHARED:
            made = parts[0]
        else:
            made = _MARK if name == "MARK" else (1, 1)
        stack.extend([made] * len(opcode.stack_after))


def _popped(stack: list, before: list) -> list:
    """What an instruction takes from the stack, without marks."""
    parts = []
    if pickletools.markobject in before:
        while (top := stack.pop()) is not _MARK:
            parts.append(top)
        before = before[: before.index(pickletools.markobject)]
    parts.extend(stack.pop() for _ in before)
    return parts[::-1]
