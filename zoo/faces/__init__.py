"""What a person touches: command line, tables, cards, demo and movement player."""
