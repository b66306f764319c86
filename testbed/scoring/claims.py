"""What a scenario says of claims: ``[[claims]]``, and ``[[readings]]`` of what their source leaves open. Effects in per cent."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from testbed.base.schema import Table


class ClaimConfig(Table):
    """``[[claims]]``: "``better`` beats ``than`` by so many per cent in this metric and window", or "the two are equal"."""

    id: str = ""
    """Short name in the tables."""
    better: str
    """The row that is claimed to be better."""
    than: str
    """The row that it is compared with."""
    metric: str
    """As ``testbed list metrics`` shows them."""
    window: str = "all"
    """Name of the window, or all."""
    kind: Literal["lower", "equal"] = "lower"
    """Most papers claim that a method is better; that two are the same must be said."""
    paper_improvement_pct: float | None = None
    """By how much lower, as the source states it."""
    margin_pct: float | None = Field(default=None, gt=0, lt=100)
    """Of an equality claim: the largest difference that still counts as none."""
    origin: Literal["paper", "own"] = "paper"
    """Whose claim it is; a scenario states a source's claims, and one's own are counted apart."""
    contradiction: str = ""
    """Where the source contradicts itself on this claim: both places, quoted."""
    text: str = ""
    """The claim in words, the source's where it is a paper's."""
    variant: str | None = None
    """The claim is tested only when the scenario runs in this variant."""

    @model_validator(mode="after")
    def _one_kind(self) -> ClaimConfig:
        if self.better and self.better == self.than:  # studies judge measured values, which have no rows
            raise ValueError(f"better and than both name '{self.than}'; a claim compares two rows")
        if self.kind == "equal" and self.margin_pct is None:
            raise ValueError(
                "an equality claim (kind = 'equal') needs margin_pct, the difference that still counts as none"
            )
        if self.kind == "lower" and self.margin_pct is not None:
            raise ValueError("margin_pct belongs to an equality claim: kind = 'equal'")
        if self.kind == "lower" and self.paper_improvement_pct is not None and self.paper_improvement_pct <= 0:
            raise ValueError(
                f"paper_improvement_pct is {self.paper_improvement_pct:g}: above 0, or left out where the source gives no figure; "
                "a claim that two are the same has kind = 'equal' and margin_pct"
            )
        return self


class ReadingConfig(Table):
    """``[[readings]]``: one way to read what the source leaves open; its ``overlay`` is laid over the scenario as a variant is."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.,+ -]*$", max_length=60)
    """Names the reading in tables and folders."""
    leaves_open: str = Field(min_length=1)
    """What the source does not say, and what this reading takes for it: one sentence."""
    conditions: dict[str, str] = {}
    """What tells the readings apart, for example ``{ "GNSS error" = "white" }``: a verdict that changes with it depends on it."""
    overlay: dict[str, Any] = {}
    """Without it the scenario as it stands."""

    @model_validator(mode="after")
    def _same_question(self) -> ReadingConfig:
        for section in ("scenario", "claims", "readings"):
            if section in self.overlay:
                raise ValueError(f"reading '{self.name}': a reading leaves [{section}] as it is")
        return self
