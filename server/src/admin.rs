//! What operators do: `lanemap.v1.AdminService`.

use lanemap_proto::v1::{self, admin_service_server::AdminService};
use tonic::{Request, Response, Status};

use crate::{auth::peer_of, error::Error, ingest::decode, session::registry::SessionRegistry};

/// The service of operators.
#[derive(Clone)]
pub struct AdminGrpc {
    registry: SessionRegistry,
}

impl AdminGrpc {
    pub(crate) fn new(registry: SessionRegistry) -> Self {
        Self { registry }
    }
}

#[tonic::async_trait]
impl AdminService for AdminGrpc {
    async fn forget(&self, request: Request<v1::ForgetRequest>) -> Result<Response<v1::ForgetResponse>, Status> {
        peer_of(request.extensions())?.may_administer()?;
        let whom = decode::forget(request.get_ref()).map_err(|refusal| Error::Refused(Box::new(refusal)))?;
        // In a task of its own: a caller who goes away does not stop a deletion half way.
        let registry = self.registry.clone();
        let forgetting = tokio::spawn(async move { registry.forget(&whom).await });
        let drives = forgetting.await.map_err(|_| Error::SessionGone)??;
        Ok(Response::new(v1::ForgetResponse { drives: drives as u64 }))
    }
}
