"""One set of tables for all tests of this folder."""

from __future__ import annotations

import pytest
from tables import Tables


@pytest.fixture(scope="session")
def add_row() -> Tables:
    """Adds a row to a table of figures."""
    return Tables()
