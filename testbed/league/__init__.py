"""The league: a fixed suite of tracks, a fixed protocol, and everybody's filter as a row.

entry.toml ── `entry` ──> Entry ┐
scenarios/league ── `suite` ──> Track ┴─ `cells`: sense, serialise, answer in a child, score ── `ranking` ──> `tables`
"""
