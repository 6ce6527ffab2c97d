"""Files of others: what could block, is too large or is not what it should be is refused before it is read."""
