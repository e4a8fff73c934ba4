"""What measures fits: tables of ablations, the chart of speed and accuracy, the stability suite. No fit needs any of it."""
