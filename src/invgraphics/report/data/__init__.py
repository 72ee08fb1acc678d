"""Run, comparison and study folders as the report's records."""
