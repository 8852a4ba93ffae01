"""Measured results: JSON, Markdown and PNG files that commands of this project wrote."""
