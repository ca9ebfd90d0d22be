"""Facts about the machine."""

import re

import torch

from gsim3d.io.machine import machine


def test_machine_names_device_and_sources():
    facts = machine(torch.device("cpu"))
    assert facts["device"].startswith("CPU, ") and facts["processor"]
    assert re.fullmatch("[0-9a-f]{12}", facts["sources"]) and facts["torch"] == torch.__version__
