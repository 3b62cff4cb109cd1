//! The cells of the shared map.

use lanemap_proto::v1;
use prost::Message;
use serde_json::Value;

use super::MapClient;
use crate::error::ClientError;

impl MapClient {
    /// Names of the cells of the shared map, in their order: `14-x-y`.
    ///
    /// # Errors
    /// A service that cannot be reached, or that does not list its cells.
    pub async fn cells(&self) -> Result<Vec<String>, ClientError> {
        let protocol = |reason: &str| ClientError::Protocol(format!("/cells: {reason}"));
        let mut names = Vec::new();
        let mut next = Some("/cells?limit=10000".to_owned());
        while let Some(path) = next {
            let page: Value =
                serde_json::from_slice(&self.get(&path).await?).map_err(|error| protocol(&error.to_string()))?;
            let cells = page["cells"].as_array().ok_or_else(|| protocol("it has no list of cells"))?;
            let before = names.len();
            names.extend(cells.iter().filter_map(|cell| cell["id"].as_str()).map(str::to_owned));
            // A page without cells leads nowhere.
            let last = names.last().filter(|_| names.len() > before);
            let links = page["links"].as_array();
            let has_next = links.is_some_and(|links| links.iter().any(|link| link["rel"] == "next"));
            next = last.filter(|_| has_next).map(|last| format!("/cells?limit=10000&after={last}"));
        }
        Ok(names)
    }

    /// The newest version of a cell.
    ///
    /// # Errors
    /// No such cell, a service that cannot be reached, or a map that does not decode.
    pub async fn cell(&self, name: &str) -> Result<v1::CellMap, ClientError> {
        let bytes = self.get(&format!("/cells/{name}/lanes.pb")).await?;
        v1::CellMap::decode(bytes.as_slice()).map_err(|error| ClientError::Protocol(error.to_string()))
    }
}
