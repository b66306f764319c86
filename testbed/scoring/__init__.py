"""Scoring: errors of solutions, what the runs of a Monte Carlo say together, and what follows from it for a claim.

`quantities` names what is measured, `statistics` describes many runs, `effects` compares two methods over paired runs,
`verdicts` judges claims, `readings` sets the verdicts of several readings of one source side by side.
"""
