"""Ultra-tight GNSS/INS coupling at signal level: the receiver's mind, and the runs."""
