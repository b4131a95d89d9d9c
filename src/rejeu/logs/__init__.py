"""What training came to: rows of statistics and where they go, history, evaluations, figures and videos."""
