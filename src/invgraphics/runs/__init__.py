"""Run folders on disk: the public format of runs, comparisons and studies."""
