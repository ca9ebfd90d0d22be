"""A fake clock with a simulated device queue, and a simulator whose sections take known times."""

import torch
from torch import nn


class Mark:
    """A time stamp in the device's queue; in a graph, updated by every replay."""

    at = None


class FakeClock:
    """A device with an asynchronous queue; ``wait`` synchronizes the host.

    Args:
        host_share: seconds of the host for a second of work.
        launch: seconds of the host for each piece of work, beside.
        cost: seconds that a mark takes in a graph.
    """

    def __init__(self, host_share=1.0, launch=0.0, cost=0.0):
        self.host, self.device, self.host_share, self.launch = 0.0, 0.0, host_share, launch
        self.program, self.cost = None, cost

    def work(self, seconds):
        if self.program is not None:
            self.program.append(seconds)
            return
        self.host += self.launch
        self._does(seconds)
        self.host += seconds * self.host_share

    def wait(self):
        self.host = max(self.host, self.device)

    def now(self):
        return self.host

    def mark(self):
        mark = Mark()
        if self.program is not None:
            self.program.append(mark)
        else:
            mark.at = max(self.device, self.host)
        return mark

    def capturing(self):
        return self.program is not None

    def mark_cost(self):
        return self.cost

    def seconds(self, first, last):
        return last.at - first.at

    def _does(self, item):
        if isinstance(item, Mark):
            item.at = self.device
            self.device += self.cost
        else:
            self.device = max(self.device, self.host) + item


class FakeGraph:
    """The device work of a function, captured as one launch."""

    def __init__(self, function, clock):
        function()  # tried out before, as of a real one
        self.clock, clock.program = clock, []
        function()
        self.program, clock.program = clock.program, None

    def __call__(self):
        self.clock.device = max(self.clock.device, self.clock.host)
        for item in self.program:
            self.clock._does(item)


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
