"""The evaluation harness: scores, calibration and plots of predictions."""
