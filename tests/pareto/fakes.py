"""A clock that only moves when something says so, and a simulator whose stages take given times on it."""

import torch
from torch import nn


class FakeClock:
    """A device that works through what it is asked for while the host runs on; ``wait`` lets the host catch up.

    noise: shares added to the work, one after another.
    """

    def __init__(self, waits=True, host_share=1.0):
        self.host, self.device, self.waits, self.host_share = 0.0, 0.0, waits, host_share

    def work(self, seconds):
        self.device = max(self.device, self.host) + seconds
        self.host += seconds * self.host_share

    def wait(self):
        if self.waits:
            self.host = max(self.host, self.device)

    def now(self):
        return self.host

    def mark(self):
        return max(self.device, self.host)

    def seconds(self, first, last):
        return last - first

    def delay(self, seconds):
        self.work(seconds)


class _Works(nn.Module):
    def __init__(self, clock, seconds):
        super().__init__()
        self.clock, self.own = clock, seconds

    def forward(self):
        self.clock.work(self.own)


class FakeSimulator(nn.Module):
    """encode 2 ms, dense layers 3 ms, head 1 ms."""

    def __init__(self, clock):
        super().__init__()
        self.clock = clock
        self.encoder, self.renderer = _Works(clock, 2e-3), _Works(clock, 1e-3)
        self.dynamics = nn.Module()
        self.dynamics.net = _Works(clock, 3e-3)

    def forward(self):
        self.encoder()
        self.dynamics.net()
        self.clock.work(0.5e-3)  # state and guards
        self.renderer()
        return torch.zeros(())
