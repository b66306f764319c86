"""Rows of the league: ``ours.toml`` has the named estimators, every folder an entry of another origin."""
