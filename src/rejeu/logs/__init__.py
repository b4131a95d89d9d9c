"""The results of training: rows of statistics and where they go, history, evaluations, figures and videos."""
