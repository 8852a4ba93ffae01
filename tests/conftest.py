"""Shape annotations are executed: while tests run, every function of the package checks them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from jaxtyping import config, install_import_hook

install_import_hook("zoo", "annotations.arrays_checked")


@pytest.fixture
def unannotated() -> Iterator[None]:
    """For tests of a function's own words about wrong shapes, which annotations would forestall."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
