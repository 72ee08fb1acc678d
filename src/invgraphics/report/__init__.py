"""Run folders in, tables, figures and pages out. Reads files only."""
