"""Factorial studies: cells, forecast, record, analyses."""
