"""Networks: multi-view encoder, Point Transformer, Gaussian head and their layers."""
