links = valid("dataset.json", folder).parent
must_refuse(lambda: sp.train([links, links]))
must_refuse(lambda: sp.evaluate("paper", [links, links]))
