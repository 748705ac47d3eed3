"""Croissant metadata (JSON-LD) of the packed studies in docs/studies, for search engines and data loaders.

    python scripts/croissant.py            # writes docs/studies/croissant.json
    python scripts/croissant.py --check    # exit status 1 where that is not the metadata of the files now

One file object with its SHA-256 for each packed study, and a record set with its columns. Columns are described as
docs/agents.md describes those of curve.csv, the dataset as CITATION.cff does; types are those of the Parquet file.
Source: the Croissant format, version 1.0, http://mlcommons.org/croissant/1.0.
"""

import argparse
import hashlib
import json
import re
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

ROOT = Path(__file__).parent.parent
STUDIES = ROOT / "docs" / "studies"
FILE = STUDIES / "croissant.json"
PACKED = b"pharos.study"
TYPES = {"string": "sc:Text", "int64": "sc:Integer", "double": "sc:Float", "bool": "sc:Boolean"}
OWN = {
    "id": "name of the run: a digest of its configuration",
    "record": "run.json of the run as text: configuration, versions, result, checksums (docs/agents.md)",
}
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def descriptions():
    """Column -> description: the rows of the table of curve.csv in docs/agents.md; of two names in a row, both."""
    page = (
        (ROOT / "docs" / "agents.md").read_text(encoding="utf-8").split("| column | meaning |", 1)[1].split("\n\n")[0]
    )
    found = dict(OWN)
    for row in page.splitlines()[2:]:
        names, meaning = row.strip("| ").split(" | ", 1)
        for name in re.findall(r"`(\w+)`", names):
            found[name] = re.sub(r"[`\\]", "", meaning) + "; a value for each evaluation of the run"
    return found


def packed_files():
    """The packed studies, in order of their names."""
    return [file for file in sorted(STUDIES.glob("*/*.parquet")) if PACKED in (pq.read_schema(file).metadata or {})]


def metadata():
    """The JSON-LD document."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    meanings, files, records = descriptions(), [], []
    for path in packed_files():
        schema, place = pq.read_schema(path), path.relative_to(STUDIES).as_posix()
        study = yaml.safe_load(schema.metadata[PACKED])
        about = f"study {study['name']}, {pq.read_metadata(path).num_rows} runs" + (
            f": {' '.join(study['description'].split())}" if study.get("description") else ""
        )
        name = place.removesuffix(".parquet").replace("/", "-")
        file = {"@type": "cr:FileObject", "@id": place, "name": place, "description": about, "contentUrl": place}
        file |= {"encodingFormat": "application/x-parquet", "contentSize": f"{path.stat().st_size} B"}
        files.append(file | {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()})
        fields = [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{column.name}",
                "name": column.name,
                "description": meanings[column.name],
                "dataType": TYPES[str(column.type.value_type if pa.types.is_list(column.type) else column.type)],
                **({"repeated": True} if pa.types.is_list(column.type) else {}),
                "source": {"fileObject": {"@id": place}, "extract": {"column": column.name}},
            }
            for column in schema
        ]
        record = {"@type": "cr:RecordSet", "@id": name, "name": name, "description": f"a record for each run; {about}"}
        records.append(record | {"key": {"@id": f"{name}/id"}, "field": fields})
    paper = citation["preferred-citation"]
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": "pharos-studies",
        "description": "Finished runs of deep agents on tabular MDPs, with exact values and regret at each evaluation: "
        "the packed studies of pharos. Read them back: pharos study unpack FILE.",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "citeAs": f"{citation['title']}, {citation['repository-code']}; {paper['title']}, {paper['url']}",
        "creator": [{"@type": "sc:Organization", "name": author["name"]} for author in citation["authors"]],
        "keywords": citation["keywords"],
        "license": f"https://spdx.org/licenses/{citation['license']}.html",
        "url": citation["repository-code"],
        "version": citation["version"],
        "distribution": files,
        "recordSet": records,
    }


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args(arguments).check
    text = (
        json.dumps(metadata(), ensure_ascii=False).replace('{"@type": "cr:', '\n{"@type": "cr:') + "\n"
    )  # lines to read
    if not check:
        FILE.write_text(text, encoding="utf-8")
    elif not FILE.exists() or FILE.read_text(encoding="utf-8") != text:
        print(f"{FILE.relative_to(ROOT)} is not of the packed studies here; run python scripts/croissant.py")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
