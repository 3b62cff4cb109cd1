//! A connection that says in time which protocol it speaks.
//!
//! hyper times the headers of HTTP/1 and pings HTTP/2, but waits for ever for the bytes that tell the one from the other: a
//! connection that sends nothing, or the beginning of HTTP/2's preface only, would keep its place.

use std::{
    io::{Error, ErrorKind, Result},
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    time::{Sleep, sleep},
};

/// What a connection of HTTP/2 begins with (RFC 9113, 3.4).
const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// A stream whose reads fail where its first bytes do not come in time.
#[derive(Debug)]
pub(super) struct FirstBytes<S> {
    stream: S,
    /// Bytes of the preface that have come, and when the rest is due; `None` once the protocol is known.
    waiting: Option<(usize, Pin<Box<Sleep>>)>,
}

impl<S> FirstBytes<S> {
    pub(super) fn within(time: Duration, stream: S) -> Self {
        Self { stream, waiting: Some((0, Box::pin(sleep(time)))) }
    }

    /// Takes note of what has come.
    fn note(&mut self, came: &[u8]) {
        let Some((known, _)) = &mut self.waiting else { return };
        let rest = &PREFACE[*known..];
        let is_telling = came.is_empty() || came.len() >= rest.len() || !rest.starts_with(came);
        if is_telling {
            self.waiting = None;
        } else {
            *known += came.len();
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for FirstBytes<S> {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<Result<()>> {
        let filled = buffer.filled().len();
        match Pin::new(&mut self.stream).poll_read(context, buffer) {
            Poll::Pending => {
                let is_late = |(_, due): &mut (usize, Pin<Box<Sleep>>)| due.as_mut().poll(context).is_ready();
                if self.waiting.as_mut().is_some_and(is_late) {
                    return Poll::Ready(Err(Error::new(ErrorKind::TimedOut, "the first bytes did not come in time")));
                }
                Poll::Pending
            }
            Poll::Ready(outcome) => {
                self.note(&buffer.filled()[filled..]);
                Poll::Ready(outcome)
            }
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for FirstBytes<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[std::io::IoSlice<'_>],
    ) -> Poll<Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}
