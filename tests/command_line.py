"""The command line, called in this process."""

import contextlib
import io
import sys

import pytest

from testbed import cli

SHORT = ["--set", "flight.duration_s=10", "--set", "sensors.gnss.outages=[]", "--set", "windows=[]"]
"""Ten seconds of the quickstart, in which its outage does not come up."""


def call(*arguments: str) -> tuple[int, str]:
    """Exit code and stderr of ``testbed ...``, run in this process."""
    said = io.StringIO()
    with (
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(io.StringIO()),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(sys, "argv", ["testbed", *arguments])
        try:
            cli.main()
        except SystemExit as end:
            return int(end.code or 0), said.getvalue()
    return 0, said.getvalue()
