"""From map units to metres: the factor, how sure it is, and what says so (``--scale``)."""
