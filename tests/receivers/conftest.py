"""These tests take minutes and programs of others: they run when asked for by their marker."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "receiver" in (config.option.markexpr or ""):
        return
    skip = pytest.mark.skip(reason="takes minutes: make receivers")
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(skip)
