"""What a scene calls for: effects, the plan that executes them, selections and edits."""
