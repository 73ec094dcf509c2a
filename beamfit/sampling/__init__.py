"""Drawing from posteriors: targets, moves, convergence, stores. It knows nothing of beams."""
