"""What is fetched: files, archives, weights of networks, public datasets."""
