"""Small networks that models and guides share."""
