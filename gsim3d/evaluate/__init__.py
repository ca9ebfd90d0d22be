"""Evaluation of simulators: metrics, the prediction protocol, baselines and reports."""
