"""Effects: specs of what to simulate, the plans that execute them, selections and edits."""
