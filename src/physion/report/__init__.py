"""Report of a comparison: tables, figures and one page."""
