"""What settings of a training cost, on a scene: trained, measured, compared."""
