"""Training: configuration, losses, loop, checkpoints."""

import os

# Queues of a GPU, which CUDA reads when it starts. Captured steps have more parallel branches than its default of 8.
os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")
