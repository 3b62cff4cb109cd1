//! `WatchChanges`: what changes in the shared map, as it changes, over gRPC.

use std::collections::BTreeSet;

use futures::{StreamExt, stream::BoxStream};
use lanemap_core::fleet::CellId;
use lanemap_proto::v1::{self, watch_changes_response::Told};
use prost::Message as _;
use tonic::Status;

use crate::{
    auth::Peer,
    change_feed::{ChangeFeeds, Message, Wanted},
    error::Error,
    fuse::{
        MapRevision,
        follow::{FollowError, Followed, Position},
    },
};

/// Most cells that a caller may name.
const MOST_CELLS: usize = 256;

/// What a caller is told.
pub(super) type Messages = BoxStream<'static, Result<v1::WatchChangesResponse, Status>>;

/// Begins to tell `peer` what it asks for.
pub(super) fn messages(feeds: &ChangeFeeds, peer: Peer, request: &v1::WatchChangesRequest) -> Result<Messages, Status> {
    let invalid = |field: &str, reason: String| Status::invalid_argument(format!("{field}: {reason}"));
    let after = request.after_position.as_str();
    let after = Some(after).filter(|text| !text.is_empty()).map(str::parse::<Position>).transpose();
    let after = after.map_err(|reason| invalid("after_position", reason))?;
    let wanted = Wanted {
        from: after.or(request.since_revision.map(|revision| Position::At(MapRevision(revision)))),
        followed: followed(request).map_err(|(field, reason)| invalid(field, reason))?,
        lines: request.with_lines,
    };
    let most_bytes = feeds.most_event_bytes();
    let encode = move |message| response(message, most_bytes);
    let opened = match after {
        Some(_) => feeds.open_or_reset(peer, wanted, encode),
        None => feeds.open(peer, wanted, encode),
    };
    let messages = opened.map_err(|error| match error {
        FollowError::InTheFuture { .. } => invalid("since_revision", error.to_string()),
        FollowError::TooMany { .. } => Error::Overloaded { what: error.to_string() }.into(),
    })?;
    Ok(messages.map(Ok).boxed())
}

fn followed(request: &v1::WatchChangesRequest) -> Result<Followed, (&'static str, String)> {
    match (request.cells.as_slice(), &request.within) {
        ([], None) => Ok(Followed::All),
        ([], Some(within)) => within_borders(within).map_err(|reason| ("within", reason)),
        (_, Some(_)) => Err(("within", "it cannot stand beside cells: name the cells, or where they lie".to_owned())),
        (cells, None) if cells.len() > MOST_CELLS => {
            Err(("cells", format!("{} are named, and {MOST_CELLS} may be: ask by within", cells.len())))
        }
        (cells, None) => {
            let cells: Result<BTreeSet<CellId>, _> = cells.iter().map(|name| name.parse()).collect();
            cells.map(Followed::Cells).map_err(|error| ("cells", error.to_string()))
        }
    }
}

fn within_borders(bounds: &v1::Bounds) -> Result<Followed, String> {
    let v1::Bounds { west_deg: west, south_deg: south, east_deg: east, north_deg: north } = *bounds;
    for (name, value, limit) in
        [("west_deg", west, 180.0), ("east_deg", east, 180.0), ("south_deg", south, 90.0), ("north_deg", north, 90.0)]
    {
        // NaN is outside, too.
        if !(-limit..=limit).contains(&value) {
            return Err(format!("{name} = {value} is outside -{limit} ..= {limit}"));
        }
    }
    if south > north {
        return Err(format!("south_deg = {south} is above north_deg = {north}"));
    }
    Ok(Followed::Within([west, south, east, north]))
}

fn response(message: Message, most_bytes: usize) -> v1::WatchChangesResponse {
    let (position, told) = match message {
        Message::Started(position) => {
            let (Position::At(revision) | Position::Within { since: revision, .. }) = position;
            (position, Told::Started(v1::WatchStarted { revision: revision.0 }))
        }
        Message::Happened { cell, event, position } => (position, Told::Event(event.message(cell))),
        Message::Alive(position) => (position, Told::Alive(v1::WatchAlive {})),
        Message::Reset { newest, oldest } => {
            (Position::At(newest), Told::Reset(v1::WatchReset { revision: newest.0, oldest_revision: oldest.0 }))
        }
        Message::Cell { change, position, lines } => {
            let changes = lines.filter(|lines| lines.encoded_len() <= most_bytes);
            let cell = v1::CellChanged {
                revision: change.revision.0,
                cell: change.cell.to_string(),
                from_version: changes.as_ref().map_or(change.from_version.0, |changes| changes.from_version),
                to_version: change.to_version.0,
                lines_upserted: change.lines_upserted,
                lines_removed: change.lines_removed,
                changes,
            };
            (position, Told::Cell(cell))
        }
    };
    v1::WatchChangesResponse { position: position.to_string(), told: Some(told) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bounds(west_deg: f64, south_deg: f64, east_deg: f64, north_deg: f64) -> v1::Bounds {
        v1::Bounds { west_deg, south_deg, east_deg, north_deg }
    }

    #[test]
    fn borders_off_the_earth_are_refused_by_their_names() {
        for (bounds, name) in [
            (bounds(f64::NAN, 0.0, 1.0, 1.0), "west_deg"),
            (bounds(0.0, -91.0, 1.0, 1.0), "south_deg"),
            (bounds(0.0, 2.0, 1.0, 1.0), "above"),
        ] {
            let reason = within_borders(&bounds).unwrap_err();
            assert!(reason.contains(name), "{reason}");
        }
        assert!(within_borders(&bounds(179.0, -1.0, -179.0, 1.0)).is_ok());
    }

    #[test]
    fn cells_and_borders_cannot_both_be_asked_for() {
        let request = v1::WatchChangesRequest {
            cells: vec!["14-1-1".to_owned()],
            within: Some(bounds(0.0, 0.0, 1.0, 1.0)),
            ..v1::WatchChangesRequest::default()
        };
        assert_eq!(followed(&request).unwrap_err().0, "within");
    }
}
