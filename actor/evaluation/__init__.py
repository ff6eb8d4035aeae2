"""The examination: suites and the grid test, who drives them, what is measured, tables and figures."""
