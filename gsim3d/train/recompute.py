"""Parts of a training step that the backward pass computes again instead of keeping them: less memory, same bits."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint


def recomputed(module: nn.Module, generator: torch.Generator | None = None) -> Callable[[Callable], Callable]:
    """A decorator for functions of tensors: gradients reach their arguments and the parameters of ``module`` alike.

    Args:
        module: what they call; its buffers, such as running statistics, change in the first pass only.
        generator: that they draw from; it is set back, so that both passes draw the same.
    """

    def wrap(f: Callable) -> Callable:
        def call(*arguments: Any) -> Any:
            before = None if generator is None else generator.get_state()

            def run(*arguments: Any) -> Any:
                if generator is not None:
                    generator.set_state(before)
                return f(*arguments)

            # Re-entrant checkpoints would drop the gradients of tensors inside particles.
            return checkpoint(
                run,
                *arguments,
                use_reentrant=False,
                preserve_rng_state=False,
                context_fn=lambda: (nullcontext(), _unchanged_buffers(module)),
            )

        return call

    return wrap


def recomputing(parts: Collection[str], module: nn.Module) -> Callable[..., Callable[[Callable], Callable]]:
    """(part, generator) -> :func:`recomputed` where the part is one of ``parts``, else what changes no function."""

    def choose(part: str, generator: torch.Generator | None = None) -> Callable[[Callable], Callable]:
        return recomputed(module, generator) if part in parts else (lambda f: f)

    return choose


@contextmanager
def _unchanged_buffers(module: nn.Module) -> Iterator[None]:
    before = [(buffer, buffer.clone()) for buffer in module.buffers()]
    try:
        yield
    finally:
        with torch.no_grad():
            for buffer, value in before:
                buffer.copy_(value)
