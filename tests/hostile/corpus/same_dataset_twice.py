links = valid("dataset.json", folder).parent
must_refuse(lambda: sp.lab.train([links, links]))
must_refuse(lambda: sp.lab.evaluate("paper", [links, links]))
