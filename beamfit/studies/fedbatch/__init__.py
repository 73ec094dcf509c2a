"""Fed-batch processes: mass balances whose rates are networks (report 3.5)."""
