"""What accuracy costs in time: a trained simulator under many settings, measured."""
