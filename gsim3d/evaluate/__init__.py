"""How well a simulator predicts: metrics, the protocol, reports."""
