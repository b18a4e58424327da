import{a,b}from"./chunk-UW6VTKS6.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
