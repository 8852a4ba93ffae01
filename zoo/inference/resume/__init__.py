"""How a training goes on in the same bits after an interruption."""
