"""Tables and figures of the paper, measured with the models at hand, and its ablations trained anew."""
