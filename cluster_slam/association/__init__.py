"""Which observation belongs to which flower, with nobody telling: the association of a whole session."""
