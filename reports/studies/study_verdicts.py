"""Verdicts of a study: claims judged on its own runs by the rules of the bench, in the columns of a scenario's ``verdicts.csv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from testbed.scoring.claims import ClaimConfig, ReadingConfig

SEED = 0
"""Of the resamples that intervals come from."""


def verdict_rows(
    claims: Sequence[ClaimConfig], readings: Sequence[ReadingConfig], tables: Mapping[str, pd.DataFrame]
) -> pd.DataFrame:
    """A row per claim and reading. ``tables`` maps a reading to its runs: a row per run, a column per row that claims name."""
    import pandas as pd

    from testbed.montecarlo.readings import verdict_table
    from testbed.scoring.verdicts import check_claims

    found = {}
    for reading in readings:
        table = tables[reading.name]

        def values(row: str, window: str, metric: str, table: pd.DataFrame = table) -> object:
            return table[row].to_numpy(dtype=float)

        found[reading.name] = pd.DataFrame(check_claims(claims, values, SEED))
    judged = verdict_table(SimpleNamespace(readings=readings, active_claims=lambda: list(claims)), found)
    texts = {claim.id: claim.text for claim in claims}
    judged.insert(1, "text", judged["claim"].map(texts))
    return judged.drop(columns="timed")
