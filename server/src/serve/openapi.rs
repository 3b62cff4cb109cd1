//! `/api`: the description of every address, OpenAPI 3.0, made of the same table as the router.
//!
//! [`Routes`] is the only way to a route: [`Routes::get`] takes the [`Operation`] that describes it along with its handler, so
//! that none is served undescribed. What a handler knows of query parameters and what is described are compared by a test
//! that asks every address for one that is unknown (`tests/tests/features`), and answers are compared with their schemas by
//! schemathesis (`tests/conformance`).
//!
//! To describe a new route, write its `Operation` in [`operations`] (or beside its handler), and name the shape of its answer
//! with [`Operation::answers`]: a schema of its own, or a name of [`schemas`](mod@schemas). Everything else that addresses
//! have in common (304, refusals, headers) is added here.

pub(super) mod operations;
pub(super) mod page;
pub(super) mod parameters;
pub(super) mod schemas;

use axum::{Router, handler::Handler, routing::MethodRouter, routing::get};
use serde_json::{Map, Value, json};

use super::{Shared, link_base::LinkBase};
use parameters::Parameter;

/// Media type of the description.
pub(super) const OPENAPI: &str = "application/vnd.oai.openapi+json;version=3.0";

/// What one address answers to GET.
#[derive(Clone, Debug)]
pub(super) struct Operation {
    id: String,
    tag: &'static str,
    summary: String,
    description: String,
    path: Vec<Parameter>,
    query: Vec<Parameter>,
    /// Media type and schema of the answer, for each of its forms.
    forms: Vec<(&'static str, Value)>,
    refusals: Vec<(u16, &'static str)>,
    has_tag: bool,
    may_be_empty: bool,
    is_for_all: bool,
}

impl Operation {
    /// An operation by its name, which is unique, and what it gives in a few words.
    pub(super) fn new(id: impl Into<String>, tag: &'static str, summary: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            tag,
            summary: summary.into(),
            description: String::new(),
            path: vec![],
            query: vec![],
            forms: vec![],
            refusals: vec![],
            has_tag: true,
            may_be_empty: false,
            is_for_all: false,
        }
    }

    /// What else there is to know.
    pub(super) fn describes(mut self, description: impl Into<String>) -> Self {
        self.description = description.into();
        self
    }

    /// A part of the path, in braces there.
    pub(super) fn at(mut self, parameter: Parameter) -> Self {
        self.path.push(parameter);
        self.refuses(404, "There is no such thing.")
    }

    /// Query parameters.
    pub(super) fn takes(mut self, parameters: impl IntoIterator<Item = Parameter>) -> Self {
        self.query.extend(parameters);
        self
    }

    /// A form of the answer.
    pub(super) fn answers(mut self, media_type: &'static str, schema: Value) -> Self {
        self.forms.push((media_type, schema));
        self
    }

    /// A refusal that not every address knows.
    pub(super) fn refuses(mut self, status: u16, why: &'static str) -> Self {
        if self.refusals.iter().all(|(known, _)| *known != status) {
            self.refusals.push((status, why));
        }
        self
    }

    /// The answer has no entity tag: it is of now only.
    pub(super) fn of_now(mut self) -> Self {
        self.has_tag = false;
        self
    }

    /// The answer may be that there is nothing: 204.
    pub(super) fn may_be_empty(mut self) -> Self {
        self.may_be_empty = true;
        self
    }

    /// Anybody may ask.
    pub(super) fn for_all(mut self) -> Self {
        self.is_for_all = true;
        self
    }

    fn described(&self) -> Value {
        let parameters: Vec<Value> = (self.path.iter().map(|parameter| parameter.described("path", true)))
            .chain(self.query.iter().map(|parameter| parameter.described("query", false)))
            .collect();
        let mut operation = json!({
            "operationId": self.id,
            "tags": [self.tag],
            "summary": self.summary,
            "parameters": parameters,
            "responses": self.responses(),
        });
        if !self.description.is_empty() {
            operation["description"] = self.description.clone().into();
        }
        if self.is_for_all {
            operation["security"] = json!([]);
        }
        operation
    }

    fn responses(&self) -> Map<String, Value> {
        let content: Map<String, Value> =
            self.forms.iter().map(|(kind, schema)| ((*kind).to_owned(), json!({ "schema": schema }))).collect();
        let mut answer = json!({ "description": self.summary, "content": content });
        let mut responses = Map::new();
        if self.has_tag {
            answer["headers"] = json!({ "ETag": { "$ref": "#/components/headers/ETag" } });
            responses.insert("304".into(), json!({ "$ref": "#/components/responses/NotModified" }));
        }
        responses.insert("200".into(), answer);
        if self.may_be_empty {
            responses.insert("204".into(), json!({ "description": "There is nothing here." }));
        }
        let common = [
            (400, "A query parameter is unknown, malformed, or stands more than once."),
            (406, "No form of the answer is acceptable."),
            (413, "The request has a large body."),
            (414, "Path and query are too long."),
            (431, "The headers are too large."),
            (500, "The answer could not be made."),
            (503, "The answer was not there in time."),
        ];
        let guarded = [(401, "Nobody is named who may read."), (403, "Who is named may not read.")];
        let guarded = guarded.iter().filter(|_| !self.is_for_all);
        for (status, why) in self.refusals.iter().chain(&common).chain(guarded) {
            let problem = json!({ "application/problem+json": { "schema": schemas::named("Problem") } });
            responses.entry(status.to_string()).or_insert(json!({ "description": why, "content": problem }));
        }
        responses
    }
}

/// The routes of the service, and the description of each.
pub(super) struct Routes {
    router: Router<Shared>,
    described: Vec<(String, Operation)>,
}

impl Routes {
    pub(super) fn new() -> Self {
        Self { router: Router::new(), described: vec![] }
    }

    /// Serves and describes GET (and with it HEAD) of a path.
    pub(super) fn get<T: 'static>(
        mut self,
        path: impl Into<String>,
        handler: impl Handler<T, Shared>,
        operation: Operation,
    ) -> Self {
        let path = path.into();
        self.router = self.router.route(&path, get(handler));
        self.described.push((path, operation));
        self
    }

    /// Serves a path that is no part of the interface: pages for people, and what they load.
    pub(super) fn undescribed(mut self, path: &str, methods: MethodRouter<Shared>) -> Self {
        self.router = self.router.route(path, methods);
        self
    }

    /// The router, and the description of what it serves.
    pub(super) fn into_parts(self) -> (Router<Shared>, Vec<(String, Operation)>) {
        (self.router, self.described)
    }
}

/// The description as a whole, but for the address of the server.
#[derive(Clone, Debug)]
pub(super) struct Api(Value);

impl Api {
    pub(super) fn of(operations: &[(String, Operation)]) -> Self {
        let mut paths = Map::new();
        for (path, operation) in operations {
            paths.insert(path.clone(), json!({ "get": operation.described() }));
        }
        let mut tags: Vec<&str> = operations.iter().map(|(_, operation)| operation.tag).collect();
        tags.dedup();
        let tags: Vec<Value> = tags.into_iter().map(|tag| json!({ "name": tag })).collect();
        Self(json!({
            "openapi": "3.0.3",
            "info": {
                "title": "lanemap",
                "version": env!("CARGO_PKG_VERSION"),
                "description": "The lane map of a fleet, served while it grows. Every GET is a HEAD, too; answers have strong \
                    entity tags and are asked for again with If-None-Match; refusals are problem documents (RFC 9457).",
                "license": { "name": "Apache-2.0 OR MIT" },
            },
            "servers": [],
            "tags": tags,
            "security": [{}, { "bearer": [] }],
            "paths": paths,
            "components": schemas::components(),
        }))
    }

    /// The document for a reader who reaches the service at `base`.
    pub(super) fn document(&self, base: &LinkBase) -> Value {
        let mut document = self.0.clone();
        let url = if base.as_str().is_empty() { "/" } else { base.as_str() };
        document["servers"] = json!([{ "url": url }]);
        document
    }
}
