"""Results of training: tables, curves, evaluations, videos."""
