"""Experiments of the thesis, one file each."""
