"""What the studies share: settings and sweeps, statistics, figures, the claim ledger."""
