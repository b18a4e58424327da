"""`lalaloc bench`: measure the figures of docs/results.md. Each group prints what it measured, with its n."""
