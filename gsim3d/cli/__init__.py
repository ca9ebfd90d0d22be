"""The ``gsim3d`` command: one module a subcommand."""
