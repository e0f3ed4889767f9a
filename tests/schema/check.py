"""Checks an OpenAPI document, the examples in it, and messages against its schemas.

    check.py DOCUMENT < MESSAGES

MESSAGES is a JSON list of {"schema": NAME, "message": ..., "valid": true | false}; NAME is one of the document's
components. Says what is wrong and ends with 1, or ends with 0.
"""

import json
import sys

from jsonschema import Draft202012Validator, FormatChecker
from openapi_spec_validator import OpenAPIV31SpecValidator
from referencing import Registry, Resource
from referencing.jsonschema import DRAFT202012

HERE = "urn:document"


def examples(node, place=""):
    """Every (place, schema, example) of the document."""
    if isinstance(node, list):
        for index, child in enumerate(node):
            yield from examples(child, f"{place}/{index}")
    if not isinstance(node, dict):
        return
    if isinstance(node.get("schema"), dict):
        schema = {"$ref": f"{HERE}#{place}/schema"}
        if "example" in node:
            yield place, schema, node["example"]
        for name, example in node.get("examples", {}).items():
            yield f"{place}/examples/{name}", schema, example["value"]
    elif "example" in node and "/schemas/" in place:
        yield place, {"$ref": f"{HERE}#{place}"}, node["example"]
    for key, child in node.items():
        if key not in ("example", "examples", "default", "enum", "const"):
            yield from examples(child, f"{place}/{key.replace('~', '~0').replace('/', '~1')}")


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        document = json.load(file)
    wrong = [f"{list(error.absolute_path)}: {error.message}" for error in OpenAPIV31SpecValidator(document).iter_errors()]
    registry = Registry().with_resource(HERE, Resource.from_contents(document, default_specification=DRAFT202012))

    def errors(schema, instance):
        validator = Draft202012Validator(schema, registry=registry, format_checker=FormatChecker())
        return [f"{list(error.absolute_path)}: {error.message}" for error in validator.iter_errors(instance)]

    checked = 0
    for place, schema, example in examples(document):
        wrong += [f"example at {place}: {error}" for error in errors(schema, example)]
        checked += 1
    for case in json.load(sys.stdin):
        name, message = case["schema"], case["message"]
        found = errors({"$ref": f"{HERE}#/components/schemas/{name}"}, message)
        if case["valid"]:
            wrong += [f"{name} {json.dumps(message)}: {error}" for error in found]
        elif not found:
            wrong.append(f"{name} should not allow {json.dumps(message)}")
        checked += 1
    if not checked:
        wrong.append("nothing was checked")
    for error in wrong:
        print(error)
    sys.exit(1 if wrong else 0)


main()
