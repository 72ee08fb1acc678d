"""HTML, Markdown, LaTeX, CSV and Parquet of a report."""
