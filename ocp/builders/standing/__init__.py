"""Plans of machines that stand unfastened on the ground."""
