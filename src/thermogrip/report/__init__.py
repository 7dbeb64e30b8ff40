"""Pages, plots and tables: what results look like."""
