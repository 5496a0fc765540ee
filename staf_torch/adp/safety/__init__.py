"""Keep constraints whatever the policy behind them wants."""
