"""Intervals, effects, Pareto fronts and verdicts."""
