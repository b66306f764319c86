"""The named estimators: compositions of parts, and `eskf`, which a scenario composes."""
