"""Filters as questions: how are moments taken, how often relinearised, is the model believed?"""
