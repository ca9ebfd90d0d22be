"""The paper's ablations: the same training with one thing changed, scored side by side."""
