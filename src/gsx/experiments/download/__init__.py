"""Public datasets: fetch their archives, check them, unpack them."""
