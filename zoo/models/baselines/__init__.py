"""What every model must beat: means, last values, neighbours, regressions."""
