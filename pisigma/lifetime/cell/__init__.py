"""What is known of one robot on its mount: its sessions, events, models, and which model is in use."""
