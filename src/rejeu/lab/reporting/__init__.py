"""What training came to: tables, curves, evaluations, videos."""
