"""The life of one environment in jails: starts, requests, deaths, close. Knows no Gymnasium."""
