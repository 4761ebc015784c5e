"""Zero-velocity alignment with sine and cosine of the azimuth as states: from any heading."""
