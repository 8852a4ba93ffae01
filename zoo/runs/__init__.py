"""Trained models: made, trained, asked, mixed and kept."""
