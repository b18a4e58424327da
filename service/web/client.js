import{a,c as b}from"./chunk-XRYW3VNC.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
