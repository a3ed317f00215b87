"""Tasks of cognitive science: people, models and agents make the same choices in them."""
