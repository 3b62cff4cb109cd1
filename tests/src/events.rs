//! Server-sent events, read as a browser reads them (WHATWG HTML, 9.2.6).

use reqwest::Response;
use serde_json::Value;

use crate::http;

/// One event.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Its type.
    pub name: String,
    /// The last id that was sent.
    pub id: String,
    /// Its data.
    pub data: Value,
}

/// A stream of events.
#[derive(Debug)]
pub struct Events {
    response: Response,
    unread: Vec<u8>,
    /// The last id that was sent, with an event or without.
    pub last_id: String,
    /// Comments that came.
    pub comments: usize,
}

impl Events {
    /// Opens a stream; `last_id` is sent where it is not empty.
    pub async fn open(url: &str, last_id: &str) -> Self {
        let request = http::client().get(url).header("accept", "text/event-stream");
        let request = if last_id.is_empty() { request } else { request.header("last-event-id", last_id) };
        let response = request.send().await.unwrap().error_for_status().unwrap();
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        Self { response, unread: Vec::new(), last_id: last_id.to_owned(), comments: 0 }
    }

    /// Headers of the answer.
    #[must_use]
    pub fn headers(&self) -> &reqwest::header::HeaderMap {
        self.response.headers()
    }

    /// The next event; `None` at the end of the stream.
    pub async fn next(&mut self) -> Option<Event> {
        loop {
            let block = self.block().await?;
            let (mut name, mut data) = (String::new(), String::new());
            for line in block.lines().filter(|line| !line.is_empty()) {
                match line.split_once(':').map(|(field, value)| (field, value.trim_start())) {
                    Some(("", _)) => self.comments += 1,
                    Some(("event", value)) => value.clone_into(&mut name),
                    Some(("data", value)) => data.push_str(value),
                    Some(("id", value)) => value.clone_into(&mut self.last_id),
                    Some(("retry", value)) => assert!(value.parse::<u64>().is_ok(), "{value}"),
                    other => panic!("{other:?} in {block:?}"),
                }
            }
            if !data.is_empty() {
                let data = serde_json::from_str(&data).unwrap();
                return Some(Event { name, id: self.last_id.clone(), data });
            }
        }
    }

    /// The next event, which is of this type; what happened to the road is passed over where it is not asked for.
    pub async fn expect(&mut self, name: &str) -> Event {
        loop {
            let event = self.next().await.expect("the stream goes on");
            if event.name == name {
                return event;
            }
            assert_eq!(event.name, "change", "{event:?}");
        }
    }

    /// Waits for a comment.
    pub async fn comment(&mut self) {
        let before = self.comments;
        while self.comments == before {
            let block = self.block().await.expect("the stream goes on");
            self.comments += block.lines().filter(|line| line.starts_with(':')).count();
            let mut ids = block.lines().filter_map(|line| line.strip_prefix("id: "));
            if let Some(id) = ids.next_back() {
                id.clone_into(&mut self.last_id);
            }
        }
    }

    /// The lines up to the next empty one.
    async fn block(&mut self) -> Option<String> {
        loop {
            if let Some(end) = self.unread.windows(2).position(|pair| pair == b"\n\n") {
                let rest = self.unread.split_off(end + 2);
                let block = std::mem::replace(&mut self.unread, rest);
                return Some(String::from_utf8(block).unwrap());
            }
            self.unread.extend_from_slice(&self.response.chunk().await.ok()??);
        }
    }
}
